// ---- labels beside their symbols: the important ones first; one that finds no free place is left out ----
const LINE_HEIGHT = 14;

// Which parts of the chart are taken, by cells so that few boxes [left, top, right, bottom] are compared.
function takenRoom() {
  const size = 40,
    boxes = new Map();
  const cells = box => {
    const all = [];
    for (let i = Math.floor(box[0] / size); i <= Math.floor(box[2] / size); i++)
      for (let j = Math.floor(box[1] / size); j <= Math.floor(box[3] / size); j++) all.push(i * 4096 + j);
    return all;
  };
  const apart = (a, b) => a[0] >= b[2] || a[2] <= b[0] || a[1] >= b[3] || a[3] <= b[1];
  const free = box => cells(box).every(k => (boxes.get(k) || []).every(other => apart(box, other)));
  const take = box => {
    for (const k of cells(box)) {
      if (!boxes.has(k)) boxes.set(k, []);
      boxes.get(k).push(box);
    }
  };
  return { free, take };
}
function takeSymbols(room, drawn) {
  for (const d of drawn) {
    // Dots of a crowd may lie under labels, or it would have none.
    if (!drawnWhole(d.n)) continue;
    room.take([d.u - 7, d.v - 7, d.u + 7, d.v + 7]);
    const steps = d.ahead ? Math.min(12, Math.hypot(d.ahead[0] - d.u, d.ahead[1] - d.v) / 9) : 0;
    for (let k = 1; k <= steps; k++) {
      const u = d.u + ((d.ahead[0] - d.u) * k) / steps;
      const v = d.v + ((d.ahead[1] - d.v) * k) / steps;
      room.take([u - 2, v - 2, u + 2, v + 2]);
    }
  }
}
const spotsAround = (wide, high) => [
  [14, -high / 2],
  [-14 - wide, -high / 2],
  [12, -high - 8],
  [12, 8],
  [-12 - wide, -high - 8],
  [-12 - wide, 8],
  [-wide / 2, -high - 15],
  [-wide / 2, 15],
];
function rank(d) {
  if (d.n === picked) return 0;
  if (now.alarmed.has(d.n)) return 1;
  if (objects.ambiguous[d.r]) return 2;
  return objects.stage[d.r] === STAGE.confirmed ? 3 : 4;
}
function labelInk(d) {
  if (now.alarmed.has(d.n)) return colour.alarm;
  return objects.ambiguous[d.r] ? colour.warn : colour.ink;
}
// Draws the lines at the first free place around the symbol; says whether there was one.
function placed(c, room, d, lines, w) {
  const wide = Math.max(...lines.map(t => c.measureText(t).width)) + 4;
  const high = LINE_HEIGHT * lines.length;
  const spot = spotsAround(wide, high)
    .map(([u, v]) => [d.u + u, d.v + v, d.u + u + wide, d.v + v + high])
    .find(box => box[0] > 2 && box[2] < w - 2 && room.free(box));
  if (!spot) return false;
  room.take(spot);
  c.lineWidth = 3.5;
  c.strokeStyle = colour.halo;
  lines.forEach((t, k) => {
    const v = spot[1] + LINE_HEIGHT * (k + 0.5);
    c.strokeText(t, spot[0] + 2, v);
    c.fillStyle = k ? colour.dim : labelInk(d);
    c.fillText(t, spot[0] + 2, v);
  });
  return true;
}
function labels(c, w, h, drawn) {
  const named = drawn.filter(d => objects.stage[d.r] !== STAGE.ended).sort((a, b) => rank(a) - rank(b) || a.n - b.n);
  const room = takenRoom();
  takeSymbols(room, drawn);
  // In a crowd labels stand so far apart that they are read as some of many.
  const spread = crowd.details ? 0 : 46;
  c.font = "12px system-ui, 'DejaVu Sans', sans-serif";
  c.textBaseline = "middle";
  c.textAlign = "left";
  c.setLineDash([]);
  for (const d of named) {
    const name = nameOf(d.r).slice(0, 24);
    const full = Number.isFinite(objects.speed[d.r]) && (named.length < 60 || d.n === picked);
    const high = Number.isFinite(objects.height[d.r]) ? ` ${flightLevel(objects.height[d.r])}` : "";
    const moving = `${knots(objects.speed[d.r])} ${course(courseOf(d.r))}${high}`;
    if (spread && !matters(d.n) && !room.free([d.u - 2 * spread, d.v - spread, d.u + 2 * spread, d.v + spread])) continue;
    if (!full || !placed(c, room, d, [name, moving], w)) placed(c, room, d, [name], w);
  }
}
