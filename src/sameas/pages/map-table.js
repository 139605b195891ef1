// ---- the data of the page: columns packed by pages/map.py ----
const data = JSON.parse(document.getElementById("data").textContent);
const packedTexts = JSON.parse(document.getElementById("texts").textContent);
const el = id => document.getElementById(id);

async function unpacked(base64) {
  if (typeof DecompressionStream === "undefined")
    throw new Error("this browser is too old for the map; one of 2023 or later shows it");
  const text = atob(base64),
    bytes = new Uint8Array(text.length);
  for (let k = 0; k < text.length; k++) bytes[k] = text.charCodeAt(k);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

function column(head, bytes, at) {
  const n = head.n,
    out = new Float64Array(n);
  let sum = 0;
  for (let k = 0; k < n; k++) {
    let zigzag = 0;
    for (let b = head.bytes - 1; b >= 0; b--) zigzag = zigzag * 256 + bytes[at + b * n + k];
    sum += zigzag % 2 ? -(zigzag + 1) / 2 : zigzag / 2;
    out[k] = sum * head.step;
  }
  at += head.bytes * n;
  if (head.holes) {
    for (let k = 0; k < n; k++) if (!bytes[at + k]) out[k] = NaN;
    at += n;
  }
  return [out, at];
}

// Rows of a table by instant (its column t).
function byInstant(t) {
  const start = new Uint32Array(data.instants.length + 1),
    order = new Uint32Array(t.length);
  for (const k of t) start[k + 1]++;
  for (let k = 0; k < data.instants.length; k++) start[k + 1] += start[k];
  const next = start.slice();
  t.forEach((k, row) => {
    order[next[k]++] = row;
  });
  return k => order.subarray(start[k], start[k + 1]);
}

const tables = { o: {}, r: {} };
try {
  const bytes = await unpacked(el("columns-data").textContent);
  let at = 0;
  for (const head of data.columns) {
    const [table, name] = head.name.split(".");
    [tables[table][name], at] = column(head, bytes, at);
  }
} catch (error) {
  const message = document.createElement("p");
  message.className = "broken";
  message.textContent = `The map cannot be shown: ${error.message}`;
  document.body.replaceChildren(message);
  return;
}
// map-live.js replaces the tables.
let objects = tables.o,
  records = tables.r,
  objectsAt = byInstant(objects.t),
  recordsAt = byInstant(records.t);
const textOf = (table, name, row) => data.strings[`${table}.${name}`][tables[table][name][row]];
const STAGE = Object.fromEntries(data.stages.map((name, k) => [name, k]));

// The first and last row of every object, by its number; a column has the row before each, or -1. Rows of an object are in
// the order of time.
function findRows(table, from, to, spans) {
  for (let row = from; row < to; row++) {
    const [first, before] = spans.get(table.n[row]) || [row, -1];
    table.before[row] = before;
    spans.set(table.n[row], [first, row]);
  }
  return spans;
}
objects.before = new Int32Array(objects.n.length);
let rowsOf = findRows(objects, 0, objects.n.length, new Map());

const unpackedTexts = new Map();
async function whyText(number, instant) {
  if (!packedTexts[number]) return null;
  if (!unpackedTexts.has(number))
    unpackedTexts.set(number, JSON.parse(new TextDecoder().decode(await unpacked(packedTexts[number]))));
  // An explanation is valid until the next one.
  const texts = unpackedTexts.get(number);
  const since = Object.keys(texts)
    .map(Number)
    .filter(k => k <= instant);
  return since.length ? { words: texts[Math.max(...since)], at: Math.max(...since) } : null;
}

// The instant of an alarm: the nearest one; null for an alarm that is always active.
const nearestInstant = t =>
  data.instants.reduce((best, v, k) => (Math.abs(v - t) < Math.abs(data.instants[best] - t) ? k : best), 0);
for (const a of data.alarms) a.instant = a.time === null ? null : nearestInstant(a.time);
const isActive = (alarm, k) => alarm.instant === null || alarm.instant === k;

// The displayed instant.
let now = null;
function instant(k) {
  const rows = [...objectsAt(k)],
    members = new Map(rows.map(row => [objects.n[row], []]));
  const marks = [...recordsAt(k)];
  for (const r of marks) members.get(records.n[r])?.push(r);
  const rowOf = new Map(rows.map(row => [objects.n[row], row]));
  const alarmed = new Set();
  for (const a of data.alarms) if (isActive(a, k)) for (const n of a.objects) alarmed.add(n);
  return { k, time: data.instants[k], rows, marks, members, rowOf, alarmed };
}
const rivalsOf = row => [...objects.rivalRows.subarray(objects.rivals[row], objects.rivals[row + 1])];
// Of tentative objects, most are clutter of radars: they do not count as objects, and less is drawn of them.
const isTentative = row => objects.stage[row] === STAGE.tentative;
const isAmbiguous = row => !!objects.ambiguous[row] && !isTentative(row);
const numberOf = row => objects.n[row];
// Whether several sources report an object, by the probability of its members; used wherever this is displayed.
const LIKELY = 0.5;
const isSeveral = row => objects.sources[row] > 1 && !(objects.p[row] < LIKELY);
const nameOf = row => textOf("o", "label", row) || `#${numberOf(row)}`;
