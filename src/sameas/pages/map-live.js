// ---- live page: deltas from the server update the tables ----
let tick = 0,
  watching = true,
  receivedAt = performance.now();

// Whether the instant shown is the present: the slider moves it before ``watching`` follows.
const atPresent = () => watching && (!now || now.k >= last);
function applyDelta(delta) {
  if (Number.isFinite(present.t) && (!frames.length || present.t - frames[frames.length - 1].t >= data.live.every))
    frames.push({ t: present.t, objects: new Map(present.objects) });
  if (delta.whole) {
    present.objects.clear();
    present.records.clear();
  }
  for (const row of delta.objects) present.objects.set(row[O.n], row);
  for (const n of delta.gone) present.objects.delete(n);
  for (const row of delta.records) present.records.set(`${row[R.source]}:${row[R.row]}`, row);
  for (const key of delta.lost) present.records.delete(key);
  present.t = delta.t;
  present.own = delta.own;
  present.cpa = delta.cpa || {};
  present.zones = delta.zones || [];
  present.berthed = delta.berthed || [];
  showSensors(delta.alignment || {}, delta.errors || []);
  beginOwnShip();
  if (centres.own) showOwnShip();
  applyAlarms(delta.alarms || []);
  dropOldFrames();
}
function* renewal() {
  const shownTime = now && !watching ? now.time : null;
  assemble();
  for (const a of data.alarms) a.instant = a.active ? null : nearestInstant(a.time);
  yield* showing(shownTime === null ? last : nearestInstant(shownTime));
  showApproaches();
}
function renew() {
  renewing = null;
  for (const _ of renewal());
  draw();
}
// While the chart is dragged, what a tick changes is done in several frames, and the next one waits for it.
function renewByStages() {
  if (isPainting()) return nextFrame(), void requestAnimationFrame(renewByStages);
  renewing ||= renewal();
  if (!renewing.next().done) return void requestAnimationFrame(renewByStages);
  renewing = null;
  redraw();
  renewed();
}

// ---- alarms; operators may acknowledge them ----
let alarmWords = "";
function applyAlarms(alarms) {
  // Active ones first, of these those that nobody acknowledged; then calls for help, approaches, the most urgent first,
  // and the newest.
  const approaches = a => a.kind === "cpa" && !!a.active;
  const urgency = a => (approaches(a) ? (present.cpa[a.objects[0]]?.[1] ?? 0) : -a.first_s);
  const order = a => [!a.active, a.acknowledged_s !== null, a.kind !== "distress", !approaches(a), urgency(a), -a.id];
  alarms.sort((a, b) => {
    const [p, q] = [order(a), order(b)],
      k = p.findIndex((v, i) => v !== q[i]);
    return k < 0 ? 0 : p[k] - q[k];
  });
  // Approaches that have rows of their own are the most urgent ones: these change while their alarms stay the same.
  const byId = (a, b) => a.id - b.id,
    urgent = alarms.filter(approaches).slice(0, CROWD_ROWS).sort(byId);
  const words = JSON.stringify([[...alarms].sort(byId), urgent]);
  if (words === alarmWords || isAimedAt()) return;
  alarmWords = words;
  data.alarms.splice(
    0,
    Infinity,
    ...alarms.map(a => ({
      text: a.text,
      condition: a.key.split(" ")[0],
      about: a.active && a.kind === "source" ? a.key : "",
      id: a.id,
      time: a.first_s,
      objects: a.objects,
      active: !!a.active,
      fresh: !!a.active && a.acknowledged_s === null,
      instant: null,
      approaching: a.kind === "cpa" && a.active ? a.objects[0] : null,
      beside: () => {
        if (a.acknowledged_s !== null)
          return [text("span", `acknowledged ${clock(a.acknowledged_s)[0]} by ${a.acknowledged_by}`, "hint")];
        if (!data.live.operator) return [];
        const button = text("button", "acknowledge", "acknowledge");
        button.addEventListener("click", () => acknowledge([a.id], button));
        return [button];
      },
      // Every approach and call is looked at before it is acknowledged (IMO MSC.302(87), alerts of category A).
      besideAll: crowd => {
        if (!crowd[0].fresh || crowd[0].approaching !== null || crowd[0].condition === "distress" || !data.live.operator) return [];
        const button = text("button", `acknowledge all ${crowd.length}`, "acknowledge");
        button.addEventListener("click", () => acknowledge(crowd.map(one => one.id), button));
        return [button];
      },
    })),
  );
  for (const a of data.alarms) a.instant = a.active ? null : nearestInstant(a.time);
  listAlarms();
  showFaultySources();
  // What nobody has acknowledged yet is filled with red, and in the title of the window.
  const fresh = data.alarms.filter(a => a.fresh).length;
  el("alarm-button").classList.toggle("acknowledged", !fresh);
  document.title = (fresh ? `⚠ ${fresh} – ` : "") + windowTitle;
}
const windowTitle = document.title;
// An alarm keeps the text it was raised with; the present closest approach follows it.
function showApproaches() {
  for (const a of data.alarms) {
    const near = a.approaching === null ? null : present.cpa[a.approaching],
      button = a.item.querySelector("button");
    let place = button.querySelector(".hint");
    if (!near) place?.remove();
    else {
      if (!place) button.append((place = text("span", "", "hint")));
      place.textContent = ` – now ${near[0]} m in ${(near[1] / 60).toFixed(1)} min`;
    }
  }
}
// Whether an operator is about to acknowledge an alarm: its button does not move away below the pointer, for some seconds.
const MOST_AIMING_MS = 3000;
let aimedSince = 0;
function isAimedAt() {
  const at = performance.now();
  if (!el("alarms").querySelector(".acknowledge:hover:enabled")) aimedSince = at;
  return at > aimedSince && at - aimedSince < MOST_AIMING_MS;
}
async function acknowledge(ids, button) {
  let done = true;
  button.disabled = true;
  for (const id of ids) done = (await changed(`alarms/${id}/acknowledge`, "POST")) && done;
  if (done) return;
  button.textContent = "not acknowledged; try again";
  button.disabled = false;
}
// Whether the server has done what an operator asks for.
async function changed(path, method) {
  try {
    return (await fetch(path, { method, headers: { "X-Sameas": "1" } })).ok;
  } catch {
    return false;
  }
}

// ---- the sensors: their offsets, which of them are subtracted, and which an operator holds ----
el("tab-summary").textContent = "Sensors";
let sensorWords = "";
function showSensors(alignment, errors) {
  const words = JSON.stringify([alignment, errors]);
  // A form that is being filled in stays.
  if (words === sensorWords || el("summary").querySelector("form :focus")) return;
  sensorWords = words;
  const parts = data.sensors.flatMap((sensor, k) => (alignment[sensor.name] ? [sensorPart(sensor.name, k, alignment[sensor.name])] : []));
  parts.push(text("p", "± is one standard error. Offsets are subtracted once they are established; one that is held stays as it is. One that is set by hand is subtracted at once, exactly, until it is released; to fix offsets for good, give them as calibration in the sensor file.", "hint"));
  parts.push(...errors.map(line => text("p", line)));
  el("summary").replaceChildren(...parts);
}
function sensorPart(name, k, a) {
  const part = document.createElement("div"),
    head = text("h3", ""),
    lines = document.createElement("ul"),
    state = a.offsets.length ? a.state : `offsets: ${a.state}`;
  head.append(sourceIcon(k), ` ${name} `, text("span", data.sensors[k].kind, "hint"));
  lines.append(...a.offsets.map(line => text("li", line)));
  lines.append(text("li", a.held ? `${state}, held` : state, a.state === "subtracted" ? "established" : "hint"));
  if (a.described) lines.append(text("li", `from the sensor file, subtracted: ${a.described}`));
  for (const line of [a.by, ...a.notes]) if (line) lines.append(text("li", line, "hint"));
  part.className = "sensor";
  part.append(head, lines);
  // What the others are compared with has no offsets.
  if (data.live.operator && (a.offsets.length || a.held)) {
    const button = text("button", a.held ? "release" : "hold");
    button.setAttribute("aria-label", `${a.held ? "release" : "hold"} the offsets of ${name}`);
    button.addEventListener("click", () => hold(name, !a.held, button));
    part.append(button);
  }
  if (data.live.operator && a.settable.length) part.append(offsetForm(name, a.settable));
  return part;
}
function offsetForm(name, settable) {
  const box = document.createElement("details"),
    form = document.createElement("form"),
    bias = document.createElement("select"),
    value = document.createElement("input"),
    unit = document.createElement("select"),
    done = text("button", "set and hold"),
    answer = text("p", "", "hint");
  const option = (of, words) => Object.assign(text("option", words), { value: of });
  const units = () => unit.replaceChildren(...data.live.offsets[bias.value][1].map(u => option(u, u)));
  bias.append(...settable.map(one => option(one, data.live.offsets[one][0])));
  bias.addEventListener("change", units);
  units();
  Object.assign(value, { type: "number", step: "any", required: true });
  for (const [part, words] of [[bias, "which offset"], [value, "value"], [unit, "unit"]]) part.setAttribute("aria-label", `${words} of ${name}`);
  answer.setAttribute("role", "status");
  form.append(bias, value, unit, done, answer);
  form.addEventListener("submit", async event => {
    event.preventDefault();
    const refusal = await sent(`sources/${encodeURIComponent(name)}/offset`, { bias: bias.value, value: value.valueAsNumber, unit: unit.value });
    answer.textContent = refusal;
    if (!refusal) done.blur();
  });
  box.append(text("summary", "set an offset by hand"), form);
  return box;
}
// Why the server has not done what an operator asks for; empty where it has.
async function sent(path, content) {
  try {
    const answer = await fetch(path, { method: "POST", headers: { "X-Sameas": "1", "Content-Type": "application/json" }, body: JSON.stringify(content) });
    return answer.ok ? "" : (await answer.json()).error;
  } catch {
    return "not done; try again";
  }
}
async function hold(name, held, button) {
  const done = await changed(`sources/${encodeURIComponent(name)}/hold`, held ? "POST" : "DELETE");
  button.textContent = done ? "…" : "not done; try again";
}

// ---- explanations, of the present only ----
explain = async (number, instant) => {
  if (!atPresent()) return null;
  try {
    const answer = await fetch(`objects/${number}/why`);
    return answer.ok ? { words: await answer.text(), at: instant } : null;
  } catch {
    return null;
  }
};

// ---- own ship: the origin of ranges and bearings; the list has the closest approaches to it ----
// Later approaches are noise of the courses.
const MOST_TCPA_S = 2 * 3600;
const approachOf = r => {
  const near = atPresent() ? present.cpa[numberOf(r)] : null;
  return near && near[1] <= MOST_TCPA_S ? near : null;
};
// The length of vectors as of a ship's radar.
const OWN_VECTOR_S = 360;
function beginOwnShip() {
  if (!present.own || centres.own) return;
  centres.own = { words: "own ship", place: () => (present.own && atPresent() ? [present.own.x, present.own.y] : null) };
  const option = text("option", "about own ship");
  option.value = "own";
  el("ring").prepend(option);
  if (el("ring").dataset.chosen !== "yes") el("ring").value = "own";
  nautical = true;
  if (el("vector").dataset.chosen !== "yes") el("vector").value = OWN_VECTOR_S;
  COLUMNS.splice(
    COLUMNS.findIndex(c => c.key === "course"),
    1,
    {
      key: "cpa",
      words: "CPA nm",
      number: true,
      of: r => approachOf(r)?.[0] ?? NaN,
      say: r => (approachOf(r) ? (approachOf(r)[0] / MILE).toFixed(2) : ""),
    },
    {
      key: "tcpa",
      words: "TCPA min",
      number: true,
      of: r => approachOf(r)?.[1] ?? NaN,
      say: r => (approachOf(r) ? (approachOf(r)[1] / 60).toFixed(1) : ""),
    },
  );
  if (order.key === "number") Object.assign(order, { key: "cpa", alarmsFirst: true });
  // Rows with the former columns.
  lines.splice(0);
  el("rows").replaceChildren();
  document.body.classList.add("own-ship");
  beginAtOwnShip();
  el("zone").closest("p").after(ownWords);
  heads();
}
// The first view is about own ship, not of all aircraft within sight; the button of the whole picture has these.
const OWN_VIEW_M = 6 * MILE;
function beginAtOwnShip() {
  if (tick > 0 || restored) return;
  const place = () => {
    const [west, south, east, north] = data.extent,
      { x, y } = present.own,
      far = 1.1 * Math.max(x - west, east - x, y - south, north - y);
    Object.assign(view, { x, y, scale: Math.min(view.w, view.h) / 2 / Math.min(far, OWN_VIEW_M) });
    clampView();
    draw();
  };
  requestAnimationFrame(() => requestAnimationFrame(place));
}
// What own ship's receiver says of her, beside the time.
const ownWords = text("p", "", "hint");
ownWords.id = "own-ship";
function showOwnShip() {
  const own = present.own;
  if (!own) return void (ownWords.textContent = "own ship: position not known");
  const speed = Math.hypot(own.vx, own.vy),
    turn = earth ? earth.north(own.x, own.y) : 0,
    over = speed < 0.05 * KNOT ? "" : `  ${course(Math.atan2(own.vx, own.vy) / RAD - turn)}`;
  // What raises no alarm must be seen, on a narrow screen too: it is first.
  const berthed = present.berthed.length,
    harbour = berthed ? `harbour: ${berthed} alongside without CPA alarm – ` : "";
  ownWords.textContent = `${harbour}own ship ${knots(speed)}${over}${own.heading === null ? "" : `, heading ${course(own.heading)}`}`;
}
for (const id of ["ring", "vector"]) el(id).addEventListener("change", () => (el(id).dataset.chosen = "yes"));
overlays.push(c => {
  const own = present.own;
  if (!own || !watching) return;
  const [u, v] = toScreen(own.x, own.y),
    far = +el("vector").value * view.scale;
  c.setLineDash([]);
  strokeOnHalo(c, outlineAt("circle", u, v, 9), colour.accent, 2);
  strokeOnHalo(c, outlineAt("circle", u, v, 4), colour.accent, 2);
  const path = new Path2D();
  path.moveTo(u, v);
  path.lineTo(u + own.vx * far, v - own.vy * far);
  strokeOnHalo(c, path, colour.accent, 2);
  // The heading line of a radar.
  if (own.heading === null) return;
  const angle = (own.heading + (earth ? earth.north(own.x, own.y) : 0)) * RAD,
    long = view.w + view.h;
  const ahead = new Path2D();
  ahead.moveTo(u, v);
  ahead.lineTo(u + long * Math.sin(angle), v - long * Math.cos(angle));
  c.lineWidth = 1;
  c.strokeStyle = colour.accent;
  c.stroke(ahead);
});
// Guard zones, where they are now.
overlays.push(c => {
  if (!watching) return;
  c.setLineDash([8, 4]);
  for (const [name, lines] of present.zones) {
    const path = new Path2D();
    for (const line of lines) line.forEach(([x, y], k) => path[k ? "lineTo" : "moveTo"](...toScreen(x, y)));
    strokeOnHalo(c, path, colour.alarm, 1.5);
    const [u, v] = toScreen(...lines[0].reduce((top, at) => (at[1] > top[1] ? at : top)));
    Object.assign(c, { font, textAlign: "center", textBaseline: "middle" });
    haloed(c, name.slice(0, 24), u, v - 9, colour.alarm);
  }
  c.setLineDash([]);
});
furtherFacts.push(r => {
  const near = approachOf(r);
  return near
    ? [
        ["CPA", distance(near[0])],
        ["TCPA", duration(Math.round(near[1]))],
        ...(present.berthed.includes(numberOf(r)) ? [["CPA alarm", "none: alongside, in a harbour"]] : []),
      ]
    : [];
});

// ---- time: the present, unless the user goes back ----
slider.addEventListener("input", () => {
  watching = +slider.value >= last;
  mark();
});
el("player").title = "▶ returns to the present";
for (const id of ["back", "on", "play"]) {
  const button = el(id),
    fresh = button.cloneNode(true);
  button.replaceWith(fresh);
  fresh.addEventListener("click", () => {
    if (id === "play") watching = true;
    else show(now.k + (id === "on" ? 1 : -1));
    if (id !== "play") watching = now.k >= last;
    mark();
    if (watching) renew();
  });
}
el("pace-label").hidden = true;
const liveMark = document.createElement("span");
liveMark.id = "live-state";
el("clock").append(" ", liveMark);
function mark() {
  const silent = (performance.now() - receivedAt) / 1000,
    broken = silent > Math.max(5, 5 * data.live.tick);
  liveMark.textContent = broken ? `no news for ${Math.round(silent)} s` : watching ? data.live.word : "looking back";
  liveMark.className = broken ? "broken-live" : watching ? "on-live" : "";
  // Her speed is that of now.
  ownWords.hidden = !watching;
  document.body.dataset.live = broken ? "broken" : watching ? "yes" : "back";
}
setInterval(mark, 1000);

// ---- a page that was opened before the first reports, or whose objects have left its ground, is loaded anew ----
const KEPT_VIEW = "sameas view",
  RELOADS_APART_MS = 30000;
function outgrown(delta) {
  if (!watching) return false;
  if (delta.geographic && !data.origin) return true;
  const beyond = row => row[O.x] < boxWest || row[O.x] > boxEast || row[O.y] < boxSouth || row[O.y] > boxNorth;
  return delta.objects.some(row => row[O.stage] === STAGE.confirmed && row[O.x] !== null && beyond(row));
}
function reloaded() {
  const kept = JSON.parse(sessionStorage.getItem(KEPT_VIEW) || "{}");
  if (Date.now() - (kept.at || 0) < RELOADS_APART_MS) return false;
  const { x, y, scale } = view;
  sessionStorage.setItem(KEPT_VIEW, JSON.stringify({ at: Date.now(), off: layersOff(), place: data.origin && { x, y, scale } }));
  location.reload();
  return true;
}
const layersOff = () => [...document.querySelectorAll("[data-layer]")].filter(e => !e.checked).map(e => e.dataset.layer);
let restored = false;
function restoreView() {
  const kept = JSON.parse(sessionStorage.getItem(KEPT_VIEW) || "{}");
  if (!kept.at || kept.restored) return;
  restored = true;
  sessionStorage.setItem(KEPT_VIEW, JSON.stringify({ at: kept.at, restored: true }));
  for (const e of document.querySelectorAll("[data-layer]")) if ((kept.off || []).includes(e.dataset.layer) === e.checked) e.click();
  const place = () => {
    Object.assign(view, kept.place);
    clampView();
    draw();
  };
  // After the first frame, in which the chart is fitted to its window.
  if (kept.place) requestAnimationFrame(() => requestAnimationFrame(place));
}
restoreView();

// ---- the server ----
let queued = false,
  leaving = false;
function receive(event) {
  const delta = JSON.parse(event.data);
  if (leaving) return;
  if (outgrown(delta) && reloaded()) {
    leaving = true;
    return;
  }
  receivedAt = performance.now();
  applyDelta(delta);
  tick = delta.tick;
  mark();
  if (queued) return;
  queued = true;
  requestAnimationFrame(takeIn);
}
function takeIn() {
  // While the user looks at the past, the tables are not updated.
  if (!watching && now && now.k < last) return void (queued = false);
  if (isDragged()) return renewByStages();
  renew();
  renewed();
}
function renewed() {
  queued = false;
  document.body.dataset.tick = String(tick);
}
try {
  const history = await (await fetch("history")).json();
  for (const frame of history.frames)
    frames.push({ t: frame.t, objects: new Map(frame.objects.map(row => [row[O.n], row])) });
} catch {
  /* without a past the page begins with the present */
}
const events = new EventSource("events");
events.addEventListener("whole", receive);
events.addEventListener("delta", receive);
window.mapPage.live = {
  get tick() {
    return tick;
  },
  get present() {
    return present;
  },
  get tables() {
    return { objects, counts, frames: [...written, present] };
  },
  renew,
};
mark();
