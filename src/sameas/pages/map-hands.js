// ---- controls: time, selection, keys, pointer ----
const slider = el("slider");
let last = data.instants.length - 1,
  playing = 0,
  drag = null,
  pinch = null;
const touches = new Map();

function show(k) {
  for (const _ of showing(k));
  draw();
}
// By stages, for a live page that is dragged meanwhile.
function* showing(k) {
  now = instant(Math.min(Math.max(Math.round(k), 0), last));
  slider.value = now.k;
  const [time, day] = clock(now.time);
  el("time").textContent = time;
  el("zone").textContent = data.utc ? "UTC" : "";
  el("day").textContent = day;
  slider.setAttribute("aria-valuetext", `${time} ${data.utc ? "UTC" : ""} ${day}`.trim());
  yield;
  listing();
  yield;
  showObject();
  showCounts();
  showAlarms();
  yield;
  strip();
  remember();
}
function pick(number, centred = false) {
  picked = number;
  if (number === null) following = false;
  el("follow").setAttribute("aria-pressed", String(following));
  const row = number === null ? undefined : now.rowOf.get(number);
  if (centred && row !== undefined) {
    const [u, v] = toScreen(objects.x[row], objects.y[row]),
      { w, h } = view;
    const size = Math.max(data.extent[2] - data.extent[0], data.extent[3] - data.extent[1]);
    centre(objects.x[row], objects.y[row], u < 0 || v < 0 || u > w || v > h ? 0 : (Math.min(w, h) / size) * 1.5);
  }
  listing();
  showObject();
  remember();
  draw();
  if (!centred) showLine();
}
function remember() {
  // The instants of a live page are others when it is opened again.
  const kept = [data.live ? "" : `t=${now.k}`, picked === null ? "" : `object=${picked}`].filter(Boolean).join("&");
  if (kept === location.hash.slice(1)) return;
  try {
    history.replaceState(null, "", `#${kept}`);
  } catch {
    /* some browsers keep no state of files */
  }
}
function recall() {
  const kept = new URLSearchParams(location.hash.slice(1)),
    number = +kept.get("object");
  show(kept.has("t") && Number.isFinite(+kept.get("t")) ? +kept.get("t") : firstFullInstant());
  if (kept.has("object") && rowsOf.has(number)) pick(number);
}
// The first instant with at least 0.9 of the largest number of records: there the map opens.
const firstFullInstant = () => {
  let most = 0;
  for (let k = 0; k <= last; k++) most = Math.max(most, recordsAt(k).length);
  let k = 0;
  while (k < last && recordsAt(k).length < 0.9 * most) k++;
  return k;
};

function play(on) {
  clearInterval(playing);
  playing = 0;
  if (on) {
    if (now.k === last) show(0);
    playing = setInterval(() => (now.k < last ? show(now.k + 1) : play(false)), 1000 / +el("pace").value);
  }
  el("play").textContent = on ? "❚❚" : "▶";
  el("play").setAttribute("aria-label", on ? "pause" : "play");
}
function neighbour(step) {
  const rows = listed(),
    at = rows.findIndex(r => numberOf(r) === picked);
  if (rows.length) {
    pick(numberOf(rows[at < 0 ? (step > 0 ? 0 : rows.length - 1) : (at + step + rows.length) % rows.length]));
    showHidden();
  }
}
function showHidden() {
  const row = now.rowOf.get(picked),
    [u, v] = toScreen(objects.x[row], objects.y[row]);
  if (u < 20 || v < 20 || u > view.w - 20 || v > view.h - 20) centre(objects.x[row], objects.y[row]);
}

// Above the slider: numbers of objects and of ambiguous ones; alarms as ticks.
const counted = k => {
  let live = 0,
    doubt = 0;
  for (const r of objectsAt(k))
    if (objects.stage[r] !== STAGE.ended && !isTentative(r)) {
      live++;
      if (objects.ambiguous[r]) doubt++;
    }
  return [live, doubt];
};
let counts = data.instants.map((_, k) => counted(k));
function strip() {
  const [c, w, h] = surface(el("strip")),
    most = Math.max(1, ...counts.map(n => n[0])),
    at = k => (last ? (k / last) * (w - 1) : w / 2),
    wide = Math.max(1, last ? (w - 1) / last : w);
  c.clearRect(0, 0, w, h);
  counts.forEach(([live, doubt], k) => {
    c.fillStyle = colour.old;
    c.globalAlpha = 0.5;
    c.fillRect(at(k) - wide / 2, h - (live / most) * (h - 3), wide + 0.5, h);
    c.globalAlpha = 1;
    if (doubt) {
      c.fillStyle = colour.warn;
      const high = Math.max(2, (doubt / most) * (h - 3));
      c.fillRect(at(k) - wide / 2, h - high, wide + 0.5, high);
    }
  });
  c.fillStyle = colour.alarm;
  for (const a of data.alarms) if (a.instant !== null) c.fillRect(at(a.instant) - 1, 0, 2, h);
  c.fillStyle = colour.ink;
  c.fillRect(at(now.k) - 0.75, 0, 1.5, h);
}

function theme(dark) {
  night = dark;
  document.documentElement.classList.toggle("night", dark);
  el("theme").textContent = dark ? "Day" : "Night";
  el("theme").setAttribute("aria-pressed", String(dark));
  readColours();
  showLegend();
  if (now) {
    showCounts();
    listing();
    showObject();
    strip();
    draw();
  }
}
// The colours that were last chosen here: a page that is opened at night does not dazzle.
const THEME = "sameas map colours";
function chooseTheme(dark) {
  theme(dark);
  try {
    localStorage.setItem(THEME, dark ? "night" : "day");
  } catch {
    /* a page from a file may have no storage */
  }
}
function usualTheme() {
  let kept = null;
  try {
    kept = localStorage.getItem(THEME);
  } catch {
    /* as above */
  }
  theme(kept ? kept === "night" : matchMedia("(prefers-color-scheme: dark)").matches);
}
const nearestPeriod = (wanted, periods) =>
  periods.reduce((best, s) => (Math.abs(Math.log(s / wanted)) < Math.abs(Math.log(best / wanted)) ? s : best));
// Default length of course vectors: for fast objects a tenth of the chart, shorter if there are many objects.
function usualAhead() {
  const speeds = [...objects.speed].filter(v => v > 0.5).sort((a, b) => a - b);
  const fast = speeds[Math.floor(0.9 * speeds.length)] || 1;
  const size = Math.max(data.extent[2] - data.extent[0], data.extent[3] - data.extent[1]);
  return (size / fast) * Math.min(0.1, 1 / Math.sqrt(Math.max(rowsOf.size, 1)));
}
function choices() {
  const span = data.instants[last] - data.instants[0];
  const ahead = PERIODS.filter(s => s <= 3600),
    back = [...PERIODS.filter(s => s < span), 1e12];
  const named = periods => [[0, "none"], ...periods.map(s => [s, s < 1e12 ? duration(s) : "all"])];
  options(el("vector"), named(ahead), nearestPeriod(usualAhead(), ahead));
  options(el("trail"), named(back), nearestPeriod(Math.max(span / 4, 1), back));
  const sited = data.sensors.flatMap((s, k) => (s.site || s.sites ? [[k, `about ${s.name}`]] : []));
  options(el("ring"), [["", "none"], ["object", "about the selected object"], ...sited], sited.length ? sited[0][0] : "");
  options(
    el("pace"),
    [1, 2, 5, 10, 20].map(n => [n, `${n}/s`]),
    last > 100 ? 10 : 5,
  );
}

function keys(e) {
  if (e.ctrlKey || e.metaKey || e.altKey || (/^(INPUT|SELECT|TEXTAREA)$/.test(e.target.tagName) && e.target !== slider))
    return;
  const onChart = e.target === chart,
    step = 70 / view.scale,
    onButton = /^(BUTTON|SUMMARY)$/.test(e.target.tagName);
  const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
  const acts = {
    ArrowLeft: () => el("back").click(),
    ArrowRight: () => el("on").click(),
    Home: () => slideTo(0),
    End: () => slideTo(last),
    "+": () => zoom(1.5),
    "=": () => zoom(1.5),
    "-": () => zoom(1 / 1.5),
    0: whole,
    n: () => neighbour(1),
    p: () => neighbour(-1),
    f: follow,
    d: () => chooseTheme(!night),
    a: () => el("alarm-button").click(),
    Escape: () => pick(null),
  };
  if (onChart && moves[e.key]) {
    following = false;
    centre(view.x + moves[e.key][0], view.y + moves[e.key][1]);
  } else if (e.key === " " && !onButton) el("play").click();
  else if (e.target === slider && /^(Arrow|Home|End)/.test(e.key)) return;
  else if (acts[e.key] || acts[e.key.toLowerCase()]) (acts[e.key] || acts[e.key.toLowerCase()])();
  else return;
  e.preventDefault();
}
// By key as by hand: a live page has its own buttons.
function slideTo(k) {
  slider.value = k;
  slider.dispatchEvent(new Event("input"));
}
function follow() {
  following = !following && picked !== null;
  el("follow").setAttribute("aria-pressed", String(following));
  draw();
}

function pointers() {
  chart.addEventListener(
    "wheel",
    e => {
      e.preventDefault();
      zoom(Math.exp(-0.0016 * e.deltaY * (e.deltaMode ? 20 : 1)), e.offsetX, e.offsetY);
    },
    { passive: false },
  );
  chart.addEventListener("pointerdown", e => {
    touches.set(e.pointerId, [e.offsetX, e.offsetY]);
    chart.setPointerCapture(e.pointerId);
    if (touches.size === 2) {
      const [a, b] = [...touches.values()];
      pinch = Math.hypot(a[0] - b[0], a[1] - b[1]);
      drag = null;
    } else {
      drag = { u: e.offsetX, v: e.offsetY, x: view.x, y: view.y, moved: false };
      prepareLayer();
    }
  });
  chart.addEventListener("pointermove", e => {
    if (touches.has(e.pointerId)) touches.set(e.pointerId, [e.offsetX, e.offsetY]);
    if (pinch && touches.size === 2) {
      const [a, b] = [...touches.values()],
        apart = Math.hypot(a[0] - b[0], a[1] - b[1]);
      zoom(apart / pinch, (a[0] + b[0]) / 2, (a[1] + b[1]) / 2);
      pinch = apart;
      return;
    }
    cursor(e.offsetX, e.offsetY);
    if (!drag) return;
    if (Math.hypot(e.offsetX - drag.u, e.offsetY - drag.v) > 5) drag.moved = true;
    if (drag.moved) {
      following = false;
      el("follow").setAttribute("aria-pressed", "false");
      view.x = drag.x - (e.offsetX - drag.u) / view.scale;
      view.y = drag.y + (e.offsetY - drag.v) / view.scale;
      clampView();
      nextFrame();
    }
  });
  const up = e => {
    touches.delete(e.pointerId);
    if (touches.size < 2) pinch = null;
    if (drag && !drag.moved && e.type === "pointerup") pick(nearest(e.offsetX, e.offsetY));
    if (drag && drag.moved) draw();
    layer = nextLayer = drag = null;
  };
  chart.addEventListener("pointerup", up);
  chart.addEventListener("pointercancel", up);
  chart.addEventListener("dblclick", e => zoom(2, e.offsetX, e.offsetY));
}
function cursor(u, v) {
  const place = toMetres(u, v),
    from = ringCentre();
  el("place").textContent =
    placeWords(...place) + (from ? (([b, r]) => `   ${course(b)} ${distance(r)}`)(bearingRange(from, place)) : "");
}
function tabs() {
  const names = ["list", "alarms", "summary", "help"];
  const open = name =>
    names.forEach(n => {
      el(n).hidden = n !== name;
      el("tab-" + n).setAttribute("aria-selected", String(n === name));
      el("tab-" + n).tabIndex = n === name ? 0 : -1;
      if (now && n === name && n === "list") listing();
    });
  names.forEach((n, k) => {
    el("tab-" + n).addEventListener("click", () => open(n));
    el("tab-" + n).addEventListener("keydown", e => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[e.key];
      if (!step) return;
      const to = names[(k + step + names.length) % names.length];
      open(to);
      el("tab-" + to).focus();
      e.preventDefault();
      e.stopPropagation();
    });
  });
  el("alarm-button").addEventListener("click", () => {
    open("alarms");
    el("alarms").scrollIntoView({ block: "nearest" });
  });
  open("list");
}
function onTables() {
  for (const tick of document.querySelectorAll("[data-layer]"))
    tick.addEventListener("change", () => {
      shown[tick.dataset.layer] = tick.checked;
      if (tick.dataset.layer === "tentative") listing();
      draw();
    });
  for (const name of ["vector", "trail", "ring"])
    el(name).addEventListener("change", () => {
      showObject();
      draw();
    });
  el("legend").addEventListener("toggle", draw);
  el("search").addEventListener("input", () => {
    el("list-scroll").scrollTop = 0;
    listing();
  });
  el("search").addEventListener("keydown", e => {
    if (e.key === "Enter" && listed().length) pick(numberOf(listed()[0]), true);
  });
  el("list-scroll").addEventListener("scroll", () => requestAnimationFrame(listing));
}
function onButtons() {
  const acts = {
    play: () => play(!playing),
    back: () => show(now.k - 1),
    on: () => show(now.k + 1),
    closer: () => zoom(1.6),
    farther: () => zoom(1 / 1.6),
    whole,
    follow,
    theme: () => chooseTheme(!night),
  };
  for (const [id, act] of Object.entries(acts)) el(id).addEventListener("click", act);
  slider.addEventListener("input", () => {
    play(false);
    show(+slider.value);
  });
  el("pace").addEventListener("change", () => {
    if (playing) play(true);
  });
}
// A view that shows everything still does so after the window was resized.
function onResize() {
  let fitted = 0;
  return () => {
    if (!chart.clientWidth) return;
    if (!fitted || view.scale <= fitted * 1.001) {
      whole();
      fitted = view.scale;
    } else {
      limits();
      clampView();
      draw();
    }
    strip();
    listing();
  };
}
function start() {
  slider.max = last;
  // It must not cover the middle of the chart, where own ship is.
  if (el("chart-place").clientWidth < 700) el("legend").open = false;
  el("credit").textContent = data.land.length ? data.credit : "";
  choices();
  heads();
  listAlarms();
  showSummary();
  showHelp();
  tabs();
  usualTheme();
  pointers();
  onTables();
  onButtons();
  document.addEventListener("keydown", keys);
  window.addEventListener("hashchange", recall);
  new ResizeObserver(onResize()).observe(chart);
  recall();
  whole();
  paint();
  document.body.dataset.ready = "yes";
}
window.mapPage = {
  get crowd() {
    return crowd;
  },
  get hits() {
    return hits;
  },
  paint,
  toScreen,
  toMetres,
  view,
  pick,
  show,
  earth,
  get picked() {
    return picked;
  },
  get layer() {
    return layer;
  },
  get now() {
    return now;
  },
  get objects() {
    return objects;
  },
  get records() {
    return records;
  },
};
start();
