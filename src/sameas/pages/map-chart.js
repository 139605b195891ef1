// ---- the chart: the visible part of the plane, and the drawing of objects and records ----
const chart = el("chart");
const [boxWest, boxSouth, boxEast, boxNorth] = data.box;
// Centre, metres; scale and its limits, pixels per metre; size of the chart, pixels, and what is painted beyond its edges.
const view = { x: 0, y: 0, scale: 1, least: 1e-9, most: 1, w: 1, h: 1, spare: 0 };
// Filled by map-live.js and map-tiles.js: functions that draw above everything, or between the land and the grid, and
// functions that return further facts of an object.
const overlays = [],
  underlays = [],
  furtherFacts = [];
let picked = null,
  following = false,
  pending = false,
  hits = [];
const toScreen = (x, y) => [(x - view.x) * view.scale + view.w / 2, (view.y - y) * view.scale + view.h / 2];
const toMetres = (u, v) => [(u - view.w / 2) / view.scale + view.x, view.y - (v - view.h / 2) / view.scale];

function surface(canvas) {
  const ratio = window.devicePixelRatio || 1,
    w = canvas.clientWidth,
    h = canvas.clientHeight;
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
    canvas.width = Math.round(w * ratio);
    canvas.height = Math.round(h * ratio);
  }
  const c = canvas.getContext("2d");
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  return [c, w, h];
}
function clampView() {
  view.scale = Math.min(Math.max(view.scale, view.least), view.most);
  const halfX = view.w / 2 / view.scale,
    halfY = view.h / 2 / view.scale;
  const held = (v, low, high, half) =>
    low + half > high - half ? (low + high) / 2 : Math.min(Math.max(v, low + half), high - half);
  view.x = held(view.x, boxWest, boxEast, halfX);
  view.y = held(view.y, boxSouth, boxNorth, halfY);
}
function limits() {
  [view.w, view.h] = [chart.clientWidth, chart.clientHeight];
  view.least = Math.max(view.w / (boxEast - boxWest), view.h / (boxNorth - boxSouth));
  view.most = Math.max(20, view.least * 10);
}
function whole() {
  const [west, south, east, north] = data.extent,
    free = Math.min(70, chart.clientWidth / 8);
  limits();
  const { w, h } = view;
  // On a wide chart the open legend must not cover anything.
  const covered = el("legend").open && w > 760 ? el("legend").offsetWidth : 0;
  view.scale = Math.max(
    view.least,
    Math.min((w - covered - 2 * free) / (east - west), (h - 2 * free) / (north - south)),
  );
  view.x = (west + east) / 2 - covered / 2 / view.scale;
  view.y = (south + north) / 2;
  clampView();
  draw();
}
function zoom(factor, u = view.w / 2, v = view.h / 2) {
  const [x, y] = toMetres(u, v);
  view.scale = Math.min(Math.max(view.scale * factor, view.least), view.most);
  view.x = x - (u - view.w / 2) / view.scale;
  view.y = y + (v - view.h / 2) / view.scale;
  clampView();
  draw();
}
function centre(x, y, closer) {
  if (!Number.isFinite(x) || !Number.isFinite(y)) return;
  view.x = x;
  view.y = y;
  if (closer) view.scale = Math.max(view.scale, closer);
  clampView();
  draw();
}
const nextFrame = () => {
  if (!pending) {
    pending = true;
    requestAnimationFrame(() => {
      pending = false;
      paint();
    });
  }
};
// All anew, at once.
const draw = () => {
  layer = nextLayer = null;
  nextFrame();
};
// Objects anew: by stages, while the chart is dragged.
const redraw = () => {
  if (!isDragged() || !layer) return draw();
  isLayerOld = true;
  nextFrame();
};

function followPicked() {
  const r = now.rowOf.get(picked);
  if (!following || r === undefined || !Number.isFinite(objects.x[r])) return;
  view.x = objects.x[r];
  view.y = objects.y[r];
  clampView();
}
function paint() {
  if (!now) return;
  followPicked();
  const [c, w, h] = surface(chart);
  c.lineJoin = "round";
  c.lineCap = "butt";
  ground(c, w, h);
  if (isDragged()) copyLayer(c);
  else {
    nextLayer = null;
    for (const _ of objectStages(c, w, h));
    hits = found;
  }
  furniture(c, w, h);
  for (const overlay of overlays) overlay(c, w, h);
  document.body.dataset.drawn = String(now.k);
}

// While the chart is dragged, objects and records are copied from a layer, a canvas wider than the chart by SPARE pixels on
// each side. The next one, with new data or about another place, is painted by stages of STAGE_MS a frame, and takes its
// place when it is complete: 2 000 objects take 20 to 50 ms without a graphics card, a frame has 16, and after a stage as
// long again is spent on its pixels. PART symbols are drawn in one.
const SPARE = 240,
  STAGE_MS = 2.5,
  PART = 250;
let layer = null,
  nextLayer = null,
  isLayerOld = false,
  renewing = null; // the stages of new data on a live page; meanwhile no layer is painted
const isDragged = () => !!drag && drag.moved,
  isPainting = () => nextLayer !== null;
function copyLayer(c) {
  const ratio = window.devicePixelRatio || 1;
  if (!layer) paintLayer(Infinity);
  const shift = [(layer.x - view.x) * view.scale, (view.y - layer.y) * view.scale];
  // Aligned to device pixels, so that it stays sharp.
  const [u, v] = shift.map(d => Math.round((d - SPARE) * ratio));
  c.save();
  c.setTransform(1, 0, 0, 1, 0, 0);
  c.drawImage(layer.canvas, u, v);
  c.restore();
  if (renewing) return;
  if (nextLayer || isLayerOld || shift.some(d => Math.abs(d) > SPARE / 3)) {
    paintLayer(STAGE_MS);
    nextFrame();
  }
}
// Begins the next layer, or goes on with it, for some milliseconds.
function paintLayer(ms) {
  const end = performance.now() + ms,
    { x, y, w, h } = view;
  nextLayer ||= emptyLayer();
  Object.assign(view, { x: nextLayer.x, y: nextLayer.y, w: w + 2 * SPARE, h: h + 2 * SPARE, spare: SPARE });
  nextLayer.stages ||= objectStages(nextLayer.c, view.w, view.h);
  let isDone = false;
  while (!isDone && performance.now() < end) isDone = nextLayer.stages.next().done;
  Object.assign(view, { x, y, w, h, spare: 0 });
  if (isDone) [layer, nextLayer] = [nextLayer, null];
}
// Two canvases in turn.
const layerCanvases = [0, 1].map(() => document.createElement("canvas"));
function emptyLayer() {
  const ratio = window.devicePixelRatio || 1,
    canvas = layerCanvases.find(one => !layer || one !== layer.canvas),
    c = canvas.getContext("2d");
  canvas.width = Math.round((view.w + 2 * SPARE) * ratio);
  canvas.height = Math.round((view.h + 2 * SPARE) * ratio);
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  c.lineJoin = "round";
  isLayerOld = false;
  return { canvas, c, x: view.x, y: view.y, stages: null };
}
// Paints the first layer while the mouse is pressed and does not move yet.
function prepareLayer() {
  if (!drag || drag.moved || layer) return;
  paintLayer(2 * STAGE_MS);
  requestAnimationFrame(prepareLayer);
}

// Draws objects and records; yields often, so that this can be spread over several frames.
let found = [];
function* objectStages(c, w, h) {
  const ahead_s = +el("vector").value,
    drawn = now.rows.filter(r => Number.isFinite(objects.x[r]) && isInView(r)).map(r => drawnAt(r, w, h, ahead_s));
  yield;
  const density = crowding(drawn);
  // What is drawn of an object stays the same while the chart is dragged.
  crowd = view.spare ? { ...crowd, cells: density.cells } : density;
  yield;
  trails(c, w, h, drawn);
  yield;
  if (shown.ellipses) ellipses(c, drawn);
  yield;
  found = [];
  marks(c, w, h);
  yield;
  if (shown.members) memberLines(c, drawn);
  yield;
  yield* markSymbols(c);
  yield;
  yield* symbols(c, drawn);
  const inside = drawn.filter(d => d.inside);
  if (shown.labels) yield* labels(c, w, inside);
}
function drawnAt(r, w, h, ahead_s) {
  const [u, v] = toScreen(objects.x[r], objects.y[r]);
  return { r, n: objects.n[r], u, v, ahead: vectorEnd(r, u, v, ahead_s), inside: u > -60 && v > -60 && u < w + 60 && v < h + 60 };
}

// The typical distance between neighbours, px, decides what is drawn: dots, then rings with vectors, then also trails,
// records, ellipses and member lines. Objects that are picked, ambiguous or in an alarm are always drawn in full.
const CELL = 64,
  VECTORS_FROM = 22,
  DETAILS_FROM = 44,
  TENTATIVE_RADIUS = 4.5,
  MOST_RAYS = 30;
let crowd = { radius: 8, vectors: true, details: true, few: true, cells: new Map() };
const cellOf = (u, v) => Math.floor(u / CELL) * 4096 + Math.floor(v / CELL);
function crowding(drawn) {
  const cells = new Map(),
    inside = drawn.filter(d => d.inside && !isMinor(d.r));
  for (const d of inside) cells.set(cellOf(d.u, d.v), (cells.get(cellOf(d.u, d.v)) || 0) + 1);
  const spacing = inside.length > 60 ? CELL * Math.sqrt(cells.size / inside.length) : Infinity;
  return {
    // In steps of half a pixel, so that symbols keep their size while the chart is panned.
    radius: Math.min(8, Math.max(2, Math.round(spacing / 2) / 2)),
    vectors: spacing > VECTORS_FROM,
    details: spacing > DETAILS_FROM,
    few: inside.length < 60,
    cells,
  };
}
// Whether an object has few neighbours.
function isApart(d) {
  let n = 0;
  for (const u of [d.u - CELL, d.u, d.u + CELL])
    for (const v of [d.v - CELL, d.v, d.v + CELL]) n += crowd.cells.get(cellOf(u, v)) || 0;
  return n <= 6;
}
function isImportant(n) {
  return n === picked || now.alarmed.has(n) || isAmbiguous(now.rowOf.get(n));
}
// Tentative objects that nobody asks about, and whether one is drawn at all.
const isMinor = r => isTentative(r) && !isImportant(numberOf(r));
const isInView = r => shown.tentative || !isMinor(r);
const drawnInFull = n => isImportant(n) || (crowd.details && !isTentative(now.rowOf.get(n)));

function trails(c, w, h, drawn) {
  const back = +el("trail").value;
  if (!back) return;
  const kinds = new Map();
  for (const d of drawn) {
    if (!drawnInFull(d.n)) continue;
    const ink = d.n === picked ? colour.accent : colour.old,
      path = groupPath(kinds, ink, { ink });
    // Newest first; a point nearer than four pixels to the previous one is not drawn.
    let [x, y] = [d.u, d.v],
      before = d.r;
    path.moveTo(x, y);
    for (let r = objects.before[d.r]; r >= 0 && data.instants[objects.t[r]] >= now.time - back; r = objects.before[r]) {
      if (!Number.isFinite(objects.x[r])) continue;
      const [u, v] = toScreen(objects.x[r], objects.y[r]),
        gap = objects.t[before] - objects.t[r] > 20;
      before = r;
      if (!gap && Math.abs(u - x) + Math.abs(v - y) < 4) continue;
      const beyond = (u < 0 && x < 0) || (v < 0 && y < 0) || (u > w && x > w) || (v > h && y > h);
      if (gap || beyond) path.moveTo(u, v);
      else path.lineTo(u, v);
      [x, y] = [u, v];
    }
  }
  c.setLineDash([]);
  c.lineWidth = 1.3;
  c.lineJoin = "bevel";
  for (const { path, ink } of kinds.values()) {
    c.strokeStyle = ink;
    c.stroke(path);
  }
}

function addEllipse(path, table, row, u, v) {
  const major = 2 * table.major[row] * view.scale,
    minor = Math.max(2 * table.minor[row] * view.scale, 0.5),
    angle = -table.angle[row] * RAD;
  // An ellipse inside the symbol would make it illegible.
  if (!(major < 5000) || major < crowd.radius) return;
  path.moveTo(u + major * Math.cos(angle), v + major * Math.sin(angle));
  path.ellipse(u, v, major, minor, angle, 0, 2 * Math.PI);
}
function ellipses(c, drawn) {
  const kinds = new Map();
  for (const d of drawn) {
    if (!d.inside || objects.stage[d.r] === STAGE.ended || !drawnInFull(d.n)) continue;
    const ink = isAmbiguous(d.r) ? colour.warn : d.n === picked ? colour.accent : colour.dim;
    addEllipse(groupPath(kinds, ink, { ink, dash: [] }), objects, d.r, d.u, d.v);
  }
  for (const r of (shown.records && now.members.get(picked)) || []) {
    if (!shown.source[records.source[r]] || !Number.isFinite(records.x[r])) continue;
    const ink = colourOf(records.source[r]);
    addEllipse(groupPath(kinds, "record" + ink, { ink, dash: [2, 3] }), records, r, ...toScreen(records.x[r], records.y[r]));
  }
  c.lineWidth = 1.2;
  for (const { path, ink, dash } of kinds.values()) {
    c.strokeStyle = ink;
    c.setLineDash(dash);
    c.stroke(path);
  }
  c.setLineDash([]);
}

// Where a record is drawn: at its position, or for a direction at the point of its ray nearest to the object.
function markPlace(r) {
  if (Number.isFinite(records.x[r])) return [records.x[r], records.y[r]];
  const site = [records.sx[r], records.sy[r]],
    row = now.rowOf.get(records.n[r]);
  if (!Number.isFinite(site[0]) || row === undefined || !Number.isFinite(objects.x[row])) return null;
  const a = records.bearing[r] * RAD,
    far = (objects.x[row] - site[0]) * Math.sin(a) + (objects.y[row] - site[1]) * Math.cos(a);
  return [site[0] + Math.max(far, 0) * Math.sin(a), site[1] + Math.max(far, 0) * Math.cos(a)];
}
function marks(c, w, h) {
  if (!shown.records) return;
  const directions = [];
  for (const r of now.marks) {
    if (!shown.source[records.source[r]] || !(crowd.details || isImportant(records.n[r]))) continue;
    const place = rowsOf.has(records.n[r]) && markPlace(r),
      [u, v] = place ? toScreen(...place) : [NaN, NaN],
      inside = u > -10 && v > -10 && u < w + 10 && v < h + 10;
    if (Number.isFinite(records.bearing[r]) && Number.isFinite(records.sx[r])) directions.push({ r, placed: !!place, inside });
    if (inside) found.push({ u, v, r, n: records.n[r], record: true });
  }
  // Many directions would cover the chart: if there are many, or the object is out of sight, only those of important
  // objects are drawn. A direction without an object is always drawn: it has no other mark.
  const few = directions.filter(d => d.inside).length <= MOST_RAYS;
  for (const { r, placed, inside } of directions) if (!placed || (inside && few) || isImportant(records.n[r])) ray(c, r, w, h);
}
function* markSymbols(c) {
  yield* inParts(found.filter(hit => hit.record), part =>
    withSprites(c, copy => {
      for (const hit of part) copy(markSprite(records.source[hit.r], hit.n === picked ? 5 : 3.6), hit.u, hit.v);
    }),
  );
}
function* inParts(all, draw) {
  for (let k = 0; k < all.length; k += PART) {
    draw(all.slice(k, k + PART));
    yield;
  }
}
function ray(c, r, w, h) {
  const [u, v] = toScreen(records.sx[r], records.sy[r]),
    place = markPlace(r),
    limit = data.sensors[records.source[r]].range;
  const far = place
    ? Math.hypot(place[0] - records.sx[r], place[1] - records.sy[r]) * 1.15 * view.scale
    : Math.min((limit || Infinity) * view.scale, Math.hypot(w, h));
  const wide = Number.isFinite(records.sb[r]) ? 2 * records.sb[r] * RAD : 0,
    a = records.bearing[r] * RAD - Math.PI / 2;
  c.setLineDash([]);
  c.fillStyle = c.strokeStyle = colourOf(records.source[r]);
  c.globalAlpha = records.n[r] === picked ? 0.22 : 0.1;
  c.beginPath();
  c.moveTo(u, v);
  c.arc(u, v, far, a - wide, a + wide);
  c.closePath();
  c.fill();
  c.globalAlpha = records.n[r] === picked ? 0.9 : 0.4;
  c.lineWidth = 1;
  c.beginPath();
  c.moveTo(u, v);
  c.lineTo(u + far * Math.cos(a), v + far * Math.sin(a));
  c.stroke();
  c.globalAlpha = 1;
}

function memberLines(c, drawn) {
  const kinds = new Map();
  const join = (d, r, ink, width, dash) => {
    const place = shown.source[records.source[r]] && markPlace(r);
    if (!place) return;
    const [u, v] = toScreen(...place);
    if (Math.hypot(u - d.u, v - d.v) < 2) return;
    const path = groupPath(kinds, ink + width, { ink, width, dash });
    path.moveTo(d.u, d.v);
    path.lineTo(u, v);
  };
  for (const d of drawn) {
    if (!drawnInFull(d.n)) continue;
    for (const r of now.members.get(d.n)) join(d, r, colourOf(records.source[r]), d.n === picked ? 2 : 1, []);
    if (!isAmbiguous(d.r) && d.n !== picked) continue;
    for (const r of rivalsOf(d.r)) if (records.n[r] !== d.n) join(d, r, colour.warn, 1.4, [5, 4]);
  }
  for (const { path, ink, width, dash } of kinds.values()) {
    c.strokeStyle = ink;
    c.lineWidth = width;
    c.setLineDash(dash);
    c.stroke(path);
  }
  c.setLineDash([]);
}

function* symbols(c, drawn) {
  const inside = drawn.filter(d => d.inside);
  vectors(c, inside);
  yield;
  // Important objects on top.
  inside.sort((a, b) => rank(b) - rank(a));
  yield* inParts(inside, part =>
    withSprites(c, copy => {
      for (const d of part) {
        const how = {
          several: isSeveral(d.r),
          ambiguous: isAmbiguous(d.r),
          alarmed: now.alarmed.has(d.n),
          r: isImportant(d.n) ? 8 : Math.min(crowd.radius, isTentative(d.r) ? TENTATIVE_RADIUS : crowd.radius),
        };
        copy(symbolSprite(objects.stage[d.r], how), d.u, d.v);
        found.push({ u: d.u, v: d.v, n: d.n, r: d.r, record: false });
      }
    }),
  );
  const d = inside.find(d => d.n === picked);
  if (d) drawCorners(c, d.u, d.v, 17);
}
function vectors(c, inside) {
  const kinds = new Map();
  for (const d of inside) {
    if (!d.ahead || isMinor(d.r) || !(crowd.vectors || isImportant(d.n))) continue;
    const stage = objects.stage[d.r],
      dashed = stage === STAGE.coasting || stage === STAGE.tentative,
      ink = isAmbiguous(d.r) ? colour.warn : colour.ink;
    const path = groupPath(kinds, ink + dashed, { ink, dashed });
    path.moveTo(d.u, d.v);
    path.lineTo(...d.ahead);
  }
  for (const { path, ink, dashed } of kinds.values()) {
    c.setLineDash(dashed ? [6, 4] : []);
    strokeOnHalo(c, path, ink, 1.7, crowd.details ? 4.2 : 0);
  }
}
// The path that collects all lines of one style, to be stroked at once.
function groupPath(kinds, key, kind) {
  if (!kinds.has(key)) kinds.set(key, { ...kind, path: new Path2D() });
  return kinds.get(key).path;
}

// The end of an object's course vector on the screen, or null.
function vectorEnd(r, u, v, ahead_s) {
  const far = ahead_s * view.scale,
    du = objects.vx[r] * far,
    dv = -objects.vy[r] * far;
  return objects.stage[r] !== STAGE.ended && Math.hypot(du, dv) > 3 ? [u + du, v + dv] : null;
}

// The object at a point of the screen; of several, the one after the picked one.
function nearest(u, v) {
  const close = hits
    .map(hit => ({ n: hit.n, d: Math.hypot(hit.u - u, hit.v - v) + (hit.record ? 6 : 0) }))
    .filter(hit => hit.d < 24)
    .sort((a, b) => a.d - b.d);
  const numbers = [...new Set(close.map(hit => hit.n))];
  return numbers.length ? numbers[(numbers.indexOf(picked) + 1) % numbers.length] : null;
}
