// ---- live page: the tables of the history and the present ----
// A frame is an instant: rows by number of the object, or by source and row of the record. The newest is the present;
// every ten seconds one is kept as history (at most MOST_ROWS rows), for the slider and the trails. Rows of a frame are
// together, frame after frame, and each tick writes over the present, which is last: it costs as much as the present has
// rows, however long the history is.
const MOST_ROWS = 60000;
const O = Object.fromEntries(data.live.object.map((name, k) => [name, k])),
  R = Object.fromEntries(data.live.record.map((name, k) => [name, k]));
const OBJECT_TEXTS = ["label", "mmsi", "icao", "callsign", "name", "mode_a", "type"];
const sourceNumber = new Map(data.sensors.map((s, k) => [s.name, k]));
let frames = [],
  present = { t: NaN, objects: new Map(), records: new Map(), own: null, cpa: {}, berthed: [], zones: [] };

// What turns the values of a column into numbers: texts are numbered in the order in which they come.
function numberer(key) {
  const known = new Map((data.strings[key] ||= []).map((words, k) => [words, k]));
  return words => {
    if (!known.has(words || "")) known.set(words || "", data.strings[key].push(words || "") - 1);
    return known.get(words || "");
  };
}
const orNaN = v => (v === null || v === undefined ? NaN : v);
const objectNumbers = Object.keys(O).map(name => [name, O[name], OBJECT_TEXTS.includes(name) ? numberer(`o.${name}`) : orNaN]);
const recordNumbers = Object.keys(R).map(name => [
  name,
  R[name],
  name === "track_id" ? numberer("r.track_id") : name === "source" ? source => sourceNumber.get(source) : orNaN,
]);

// Columns with room for more rows than are used; the frames of the history in them, the row where each begins and the one
// after the last, and the first and last row of every object.
const room = Object.fromEntries(["t", "before", "rivals", ...Object.keys(O)].map(name => [name, new Float64Array(0)]));
let written = [],
  starts = [0],
  spans = new Map();
function writeFrame(k, frame, at) {
  const rows = [...frame.objects.values()],
    end = at + rows.length;
  if (room.t.length <= end)
    for (const name in room) {
      const wider = new Float64Array(2 * end + 2);
      wider.set(room[name]);
      room[name] = wider;
    }
  room.t.fill(k, at, end);
  for (const [name, column, number] of objectNumbers) for (let i = 0; i < rows.length; i++) room[name][at + i] = number(rows[i][column]);
  return end;
}
function forgetFrames() {
  const found = written.indexOf(frames[0]),
    gone = found < 0 ? written.length : found,
    cut = starts[gone],
    end = starts[written.length] - cut;
  if (!gone) return;
  for (const name in room) room[name].copyWithin(0, cut, cut + end);
  for (let r = 0; r < end; r++) room.t[r] -= gone;
  starts = starts.slice(gone).map(start => start - cut);
  written = written.slice(gone);
  counts.splice(0, gone);
  spans = findRows(room, 0, end, new Map());
}
function assemble() {
  forgetFrames();
  counts.length = Math.min(counts.length, written.length);
  for (const frame of frames.slice(written.length)) {
    const at = starts[written.length],
      end = writeFrame(written.length, frame, at);
    findRows(room, at, end, spans);
    written.push(frame);
    starts.push(end);
  }
  last = written.length;
  const at = starts[last],
    end = writeFrame(last, present, at);
  rowsOf = findRows(room, at, end, new Map(spans));
  data.instants.splice(0, Infinity, ...frames.map(frame => frame.t), present.t);
  objects = tables.o = { rivalRows: new Float64Array(0) };
  for (const name in room) objects[name] = room[name].subarray(0, name === "rivals" ? end + 1 : end);
  objectsAt = k => Uint32Array.from({ length: (k < last ? starts[k + 1] : end) - starts[k] }, (_, i) => starts[k] + i);
  slider.max = last;
  assembleRecords();
  for (let k = counts.length; k <= last; k++) counts[k] = counted(k);
}
// Records of the present only: history frames have none.
function assembleRecords() {
  const rows = [...present.records.values()],
    n = rows.length;
  records = tables.r = { t: new Float64Array(n).fill(last), line: new Float64Array(n).fill(-1) };
  for (const [name, column, number] of recordNumbers) {
    const out = (records[name] = new Float64Array(n));
    for (let i = 0; i < n; i++) out[i] = number(rows[i][column]);
  }
  recordsAt = byInstant(records.t);
}
function dropOldFrames() {
  let rows = 0;
  for (const frame of frames) rows += frame.objects.size;
  while (frames.length && (rows > MOST_ROWS || present.t - frames[0].t > data.live.history)) {
    rows -= frames[0].objects.size;
    frames.shift();
  }
}
