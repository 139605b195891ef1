// ---- the list of objects ----
const COLUMNS = [
  { key: "number", words: "no.", number: true, of: r => numberOf(r), say: r => String(numberOf(r)) },
  { key: "label", words: "object", of: r => nameOf(r).toLowerCase(), say: r => nameOf(r) },
  { key: "speed", words: "kn", number: true, of: r => objects.speed[r], say: r => inKnots(objects.speed[r]) },
  { key: "course", words: "course", number: true, of: r => courseOf(r), say: r => course(courseOf(r)) },
  { key: "sources", words: "seen by", of: r => (isSeveral(r) ? -objects.sources[r] : objects.sources[r] ? -1 : 0), say: null },
  {
    key: "p",
    words: "p",
    number: true,
    of: r => objects.p[r],
    say: r => (now.members.get(numberOf(r)).length > 1 ? probability(objects.p[r]).replace("> 0.9999", "1.00").replace("< 0.0001", "0.00") : ""),
  },
];
// Of approaches to own ship, objects in an alarm are first until the user chooses an order.
const order = { key: "number", down: false, alarmsFirst: false };
// Only visible rows are in the document: a picture may have thousands of objects. A finger needs higher ones.
const ROW_HEIGHT = matchMedia("(pointer: coarse)").matches ? 40 : 25,
  MARGIN = 4;
// Maximum number of source icons in a row; further sources are counted.
const MOST_ICONS = 4;
const lines = [],
  spacers = [0, 1].map(() => {
    const tr = document.createElement("tr");
    tr.setAttribute("aria-hidden", "true");
    tr.className = "spacer";
    return tr;
  });

function heads() {
  el("columns").replaceChildren(
    ...COLUMNS.map(column => {
      const th = document.createElement("th"),
        button = text("button", column.words);
      th.scope = "col";
      if (column.number) th.className = "number";
      th.dataset.key = column.key;
      // Icons are 19 pixels wide, a question mark after them 13.
      if (column.key === "sources") th.style.width = `${Math.max(68, 25 + 19 * Math.min(data.sensors.length, MOST_ICONS))}px`;
      button.addEventListener("click", () => {
        order.down = order.key === column.key && !order.down;
        order.key = column.key;
        order.alarmsFirst = false;
        listing();
      });
      th.append(button);
      return th;
    }),
  );
}
function wanted(r, words) {
  if (objects.stage[r] === STAGE.ended || !isInView(r)) return false;
  return (
    !words ||
    ["label", "name", "callsign", "mmsi", "icao", "mode_a", "type"].some(key =>
      textOf("o", key, r).toLowerCase().includes(words),
    ) ||
    String(numberOf(r)) === words.replace("#", "")
  );
}
function listed() {
  const column = COLUMNS.find(c => c.key === order.key),
    sign = order.down ? -1 : 1,
    words = el("search").value.trim().toLowerCase();
  const key = new Map(now.rows.map(r => [r, column.of(r)]));
  const rank = v => (typeof v === "number" && Number.isNaN(v) ? 1 : 0),
    calm = r => (order.alarmsFirst && now.alarmed.has(numberOf(r)) ? 0 : isMinor(r) ? 2 : 1);
  return now.rows
    .filter(r => wanted(r, words))
    .sort((a, b) => {
      const [u, v] = [key.get(a), key.get(b)];
      return calm(a) - calm(b) || rank(u) - rank(v) || sign * (u < v ? -1 : u > v ? 1 : 0) || numberOf(a) - numberOf(b);
    });
}
function line() {
  const tr = document.createElement("tr");
  tr.tabIndex = 0;
  tr.append(
    ...COLUMNS.map(c => {
      const td = document.createElement("td");
      td.className = c.number ? "number" : c.key;
      return td;
    }),
  );
  // A live list may be in another order when the button is released; a click of a program has pressed none.
  let pressed = null;
  tr.addEventListener("pointerdown", () => (pressed = tr.dataset.number));
  tr.addEventListener("click", e => pick(+((e.detail && pressed) || tr.dataset.number), true));
  tr.addEventListener("keydown", e => {
    if (e.key === "Enter") pick(+tr.dataset.number, true);
    const step = { ArrowDown: "nextElementSibling", ArrowUp: "previousElementSibling" }[e.key];
    if (step) {
      if (tr[step] && lines.includes(tr[step])) tr[step].focus();
      e.preventDefault();
      e.stopPropagation();
    }
  });
  return tr;
}
function listing() {
  for (const th of el("columns").children)
    th.setAttribute("aria-sort", th.dataset.key !== order.key ? "none" : order.down ? "descending" : "ascending");
  const rows = listed(),
    box = el("list-scroll");
  const first = Math.max(0, Math.min(Math.floor(box.scrollTop / ROW_HEIGHT) - MARGIN, rows.length - 1));
  const part = rows.slice(first, first + Math.ceil(box.clientHeight / ROW_HEIGHT) + 2 * MARGIN);
  while (lines.length < part.length) lines.push(line());
  if (el("rows").childElementCount !== part.length + 2)
    el("rows").replaceChildren(spacers[0], ...lines.slice(0, part.length), spacers[1]);
  part.forEach((r, k) => {
    fill(lines[k], r);
    lines[k].classList.toggle("even", (first + k) % 2 === 1);
    lines[k].setAttribute("aria-rowindex", first + k + 2);
  });
  spacers[0].style.height = `${first * ROW_HEIGHT}px`;
  spacers[1].style.height = `${(rows.length - first - part.length) * ROW_HEIGHT}px`;
  el("list-table").setAttribute("aria-rowcount", rows.length + 1);
}
function showLine() {
  const at = listed().findIndex(r => numberOf(r) === picked),
    box = el("list-scroll"),
    room = box.clientHeight - 2 * ROW_HEIGHT;
  if (at < 0 || el("list").hidden) return;
  if (at * ROW_HEIGHT < box.scrollTop) box.scrollTop = at * ROW_HEIGHT;
  else if (at * ROW_HEIGHT > box.scrollTop + room) box.scrollTop = at * ROW_HEIGHT - room;
}
function fill(tr, r) {
  const n = numberOf(r),
    faint = objects.stage[r] === STAGE.coasting || objects.stage[r] === STAGE.tentative;
  tr.dataset.number = n;
  tr.className = [
    n === picked ? "picked" : "",
    isAmbiguous(r) ? "ambiguous" : "",
    now.alarmed.has(n) ? "alarmed" : "",
    faint ? "faint" : "",
  ]
    .join(" ")
    .trim();
  tr.setAttribute("aria-selected", String(n === picked));
  COLUMNS.forEach((column, c) => {
    const td = tr.children[c];
    if (column.say) {
      const words = column.say(r);
      if (td.textContent !== words) {
        td.textContent = words;
        if (column.key === "label") td.title = words;
      }
      return;
    }
    const seen = [...new Set(now.members.get(n).map(m => records.source[m]))].sort((a, b) => a - b),
      unsure = seen.length > 1 && !isSeveral(r),
      key = seen.join() + night + unsure;
    if (td.dataset.seen === key) return;
    td.dataset.seen = key;
    td.title = (unsure ? "perhaps " : "") + seen.map(s => data.sensors[s].name).join(", ");
    td.setAttribute("aria-label", td.title || "none now");
    const icons = seen.length > MOST_ICONS ? seen.slice(0, MOST_ICONS - 1) : seen;
    td.replaceChildren(
      ...icons.map(s => sourceIcon(s)),
      ...(icons.length < seen.length ? [text("span", `+${seen.length - icons.length}`)] : []),
      ...(unsure ? [text("span", "?", "unsure")] : []),
      ...(seen.length ? [] : [text("span", data.stages[objects.stage[r]], "hint")]),
    );
  });
}
