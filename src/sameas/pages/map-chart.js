// ---- the chart: what part of the plane is seen, and what is drawn on it ----
const chart = el("chart");
const [boxWest, boxSouth, boxEast, boxNorth] = data.box;
// Metres in the middle, pixels per metre and their limits, and the size of the chart in pixels.
const view = { x: 0, y: 0, scale: 1, least: 1e-9, most: 1, w: 1, h: 1 };
// What a page that goes on draws above all, and says of an object.
const overlays = [],
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
function keep() {
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
  // What lies under the open legend is not seen: on a wide chart everything is put beside it.
  const covered = el("legend").open && w > 760 ? el("legend").offsetWidth : 0;
  view.scale = Math.max(
    view.least,
    Math.min((w - covered - 2 * free) / (east - west), (h - 2 * free) / (north - south)),
  );
  view.x = (west + east) / 2 - covered / 2 / view.scale;
  view.y = (south + north) / 2;
  keep();
  draw();
}
function zoom(factor, u = view.w / 2, v = view.h / 2) {
  const [x, y] = toMetres(u, v);
  view.scale = Math.min(Math.max(view.scale * factor, view.least), view.most);
  view.x = x - (u - view.w / 2) / view.scale;
  view.y = y + (v - view.h / 2) / view.scale;
  keep();
  draw();
}
function centre(x, y, closer) {
  if (!Number.isFinite(x) || !Number.isFinite(y)) return;
  view.x = x;
  view.y = y;
  if (closer) view.scale = Math.max(view.scale, closer);
  keep();
  draw();
}
const draw = () => {
  if (!pending) {
    pending = true;
    requestAnimationFrame(() => {
      pending = false;
      paint();
    });
  }
};

function keepPicked() {
  const r = now.rowOf.get(picked);
  if (!following || r === undefined || !Number.isFinite(objects.x[r])) return;
  view.x = objects.x[r];
  view.y = objects.y[r];
  keep();
}
function paint() {
  if (!now) return;
  keepPicked();
  const [c, w, h] = surface(chart);
  c.lineJoin = "round";
  c.lineCap = "butt";
  ground(c, w, h);
  const drawn = now.rows
    .filter(r => Number.isFinite(objects.x[r]))
    .map(r => {
      const [u, v] = toScreen(objects.x[r], objects.y[r]);
      return {
        r,
        n: objects.n[r],
        u,
        v,
        ahead: vectorEnd(r, u, v),
        inside: u > -60 && v > -60 && u < w + 60 && v < h + 60,
      };
    });
  trails(c, drawn);
  crowd = crowding(drawn);
  if (shown.ellipses) ellipses(c, drawn);
  hits = [];
  marks(c, w, h);
  if (shown.members) memberLines(c, drawn);
  markSymbols(c);
  // What matters lies on top.
  for (const d of drawn.filter(d => d.inside).sort((a, b) => rank(b) - rank(a))) symbol(c, d, matters(d.n) ? 8 : crowd.radius);
  if (shown.labels)
    labels(
      c,
      w,
      h,
      drawn.filter(d => d.inside),
    );
  furniture(c, w, h);
  for (const overlay of overlays) overlay(c, w, h);
  document.body.dataset.drawn = String(now.k);
}

// How far apart objects are where they are, px, and what room that leaves: symbols of many shrink to dots, and what hangs
// on them comes back when one zooms in. What is picked, ambiguous or alarmed is drawn whole always.
let crowd = { radius: 8, details: true };
function crowding(drawn) {
  const cell = 40,
    cells = new Set();
  let n = 0;
  for (const d of drawn)
    if (d.inside) {
      n++;
      cells.add(Math.floor(d.u / cell) * 4096 + Math.floor(d.v / cell));
    }
  const spacing = n > 60 ? Math.sqrt((cells.size * cell * cell) / n) : Infinity;
  return { radius: Math.min(8, Math.max(2, spacing / 4)), details: spacing > 22 };
}
function matters(n) {
  return n === picked || now.alarmed.has(n) || !!objects.ambiguous[now.rowOf.get(n)];
}
const drawnWhole = n => crowd.details || matters(n);

function trails(c, drawn) {
  const back = +el("trail").value;
  if (!back) return;
  c.setLineDash([]);
  c.lineWidth = 1.3;
  c.lineJoin = "bevel";
  for (const d of drawn) {
    c.strokeStyle = d.n === picked ? colour.accent : colour.old;
    c.beginPath();
    // Newest first; points nearer than four pixels to the one before are left out, as nobody sees them.
    let [x, y] = [d.u, d.v],
      before = d.r;
    c.moveTo(x, y);
    for (let r = d.r - 1; r >= rowsOf.get(d.n)[0] && data.instants[objects.t[r]] >= now.time - back; r--) {
      if (!Number.isFinite(objects.x[r])) continue;
      const [u, v] = toScreen(objects.x[r], objects.y[r]),
        gap = objects.t[before] - objects.t[r] > 20;
      before = r;
      if (!gap && Math.abs(u - x) + Math.abs(v - y) < 4) continue;
      if (gap) c.moveTo(u, v);
      else c.lineTo(u, v);
      [x, y] = [u, v];
    }
    c.stroke();
  }
}

function traceEllipse(c, table, row, u, v, sigmas) {
  const major = table.major[row] * sigmas * view.scale,
    minor = table.minor[row] * sigmas * view.scale;
  if (!(major < 5000)) return false;
  c.beginPath();
  c.ellipse(u, v, Math.max(major, 0.5), Math.max(minor, 0.5), -table.angle[row] * RAD, 0, 2 * Math.PI);
  return true;
}
function ellipses(c, drawn) {
  c.setLineDash([]);
  c.lineWidth = 1.2;
  for (const d of drawn) {
    const stage = objects.stage[d.r];
    if (!d.inside || stage === STAGE.ended || !drawnWhole(d.n) || !traceEllipse(c, objects, d.r, d.u, d.v, 2)) continue;
    c.strokeStyle = objects.ambiguous[d.r] ? colour.warn : d.n === picked ? colour.accent : colour.dim;
    c.stroke();
  }
  if (!shown.records) return;
  for (const r of now.marks) {
    if (!shown.source[records.source[r]] || !Number.isFinite(records.x[r]) || records.n[r] !== picked) continue;
    if (traceEllipse(c, records, r, ...toScreen(records.x[r], records.y[r]), 2)) {
      c.strokeStyle = colourOf(records.source[r]);
      c.setLineDash([2, 3]);
      c.stroke();
      c.setLineDash([]);
    }
  }
}

// The record where it is drawn: its position, or for a direction the point of the ray nearest to the object.
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
  for (const r of now.marks) {
    if (!shown.source[records.source[r]] || !drawnWhole(records.n[r])) continue;
    const place = rowsOf.has(records.n[r]) && markPlace(r),
      [u, v] = place ? toScreen(...place) : [NaN, NaN];
    // Of directions to what is out of sight none is drawn: of hundreds they would cover the chart.
    const unseen = place && (u < -10 || v < -10 || u > w + 10 || v > h + 10);
    if (Number.isFinite(records.bearing[r]) && Number.isFinite(records.sx[r]) && (!unseen || matters(records.n[r]))) ray(c, r, w, h);
    if (!place) continue;
    if (u > -10 && v > -10 && u < w + 10 && v < h + 10) hits.push({ u, v, r, n: records.n[r], record: true });
  }
}
function markSymbols(c) {
  for (const hit of hits) if (hit.record) drawMark(c, records.source[hit.r], hit.u, hit.v, hit.n === picked ? 5 : 3.6);
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
  for (const d of drawn) {
    if (!drawnWhole(d.n)) continue;
    c.setLineDash([]);
    c.lineWidth = d.n === picked ? 2 : 1;
    for (const r of now.members.get(d.n)) join(c, d, r, colourOf(records.source[r]));
    if (!objects.ambiguous[d.r] && d.n !== picked) continue;
    c.setLineDash([5, 4]);
    c.lineWidth = 1.4;
    for (const r of rivalsOf(d.r)) if (records.n[r] !== d.n) join(c, d, r, colour.warn);
  }
  c.setLineDash([]);
}
function join(c, d, r, ink) {
  const place = shown.source[records.source[r]] && markPlace(r);
  if (!place) return;
  const [u, v] = toScreen(...place);
  if (Math.hypot(u - d.u, v - d.v) < 2) return;
  c.strokeStyle = ink;
  c.beginPath();
  c.moveTo(d.u, d.v);
  c.lineTo(u, v);
  c.stroke();
}

function symbol(c, d, radius) {
  const stage = objects.stage[d.r];
  if (d.ahead && drawnWhole(d.n)) {
    const [u, v] = d.ahead;
    c.setLineDash(stage === STAGE.coasting || stage === STAGE.tentative ? [6, 4] : []);
    const path = new Path2D();
    path.moveTo(d.u, d.v);
    path.lineTo(u, v);
    strokeOnHalo(c, path, objects.ambiguous[d.r] ? colour.warn : colour.ink, 1.7);
  }
  drawSymbol(c, stage, d.u, d.v, {
    several: isSeveral(d.r),
    ambiguous: !!objects.ambiguous[d.r],
    alarmed: now.alarmed.has(d.n),
    r: radius,
  });
  if (d.n === picked) drawCorners(c, d.u, d.v, 17);
  hits.push({ u: d.u, v: d.v, n: d.n, r: d.r, record: false });
}

// Where the vector of an object ends on the screen, or null.
function vectorEnd(r, u, v) {
  const far = +el("vector").value * view.scale,
    du = objects.vx[r] * far,
    dv = -objects.vy[r] * far;
  return objects.stage[r] !== STAGE.ended && Math.hypot(du, dv) > 3 ? [u + du, v + dv] : null;
}

// The object under the hand; where several lie, the next one after that picked.
function nearest(u, v) {
  const close = hits
    .map(hit => ({ n: hit.n, d: Math.hypot(hit.u - u, hit.v - v) + (hit.record ? 6 : 0) }))
    .filter(hit => hit.d < 24)
    .sort((a, b) => a.d - b.d);
  const numbers = [...new Set(close.map(hit => hit.n))];
  return numbers.length ? numbers[(numbers.indexOf(picked) + 1) % numbers.length] : null;
}
