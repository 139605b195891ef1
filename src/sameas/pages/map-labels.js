// ---- labels next to their symbols, important ones first; a label without a free place is not drawn, unless it names
// what is in an alarm or picked: that may cover symbols ----
const LINE_HEIGHT = 14;

// Occupied boxes [left, top, right, bottom] of the chart, in cells so that few are compared.
function takenRoom() {
  const size = 40,
    cells = new Map();
  // Calls visit for each cell that a box touches, until it returns true.
  const some = (box, visit) => {
    for (let i = Math.floor(box[0] / size); i <= Math.floor(box[2] / size); i++)
      for (let j = Math.floor(box[1] / size); j <= Math.floor(box[3] / size); j++) if (visit(i * 4096 + j)) return true;
    return false;
  };
  const overlap = (a, b) => a[0] < b[2] && a[2] > b[0] && a[1] < b[3] && a[3] > b[1];
  const free = box => !some(box, cell => cells.has(cell) && cells.get(cell).some(other => overlap(box, other)));
  const take = box => {
    some(box, cell => {
      if (cells.has(cell)) cells.get(cell).push(box);
      else cells.set(cell, [box]);
    });
  };
  return { free, take };
}
// Widths of texts in the label font, cached.
const textWidths = new Map();
function textWidth(c, words) {
  if (!textWidths.has(words)) textWidths.set(words, c.measureText(words).width);
  return textWidths.get(words);
}
function takeSymbols(room, drawn) {
  for (const d of drawn) {
    // Labels may cover dots in a crowd, or there would be no labels.
    const half = crowd.vectors || isImportant(d.n) ? 7 : isApart(d) ? 4 : 0;
    if (!half) continue;
    room.take([d.u - half, d.v - half, d.u + half, d.v + half]);
    const steps = d.ahead && drawnInFull(d.n) ? Math.min(12, Math.hypot(d.ahead[0] - d.u, d.ahead[1] - d.v) / 9) : 0;
    for (let k = 1; k <= steps; k++) {
      const u = d.u + ((d.ahead[0] - d.u) * k) / steps;
      const v = d.v + ((d.ahead[1] - d.v) * k) / steps;
      room.take([u - 2, v - 2, u + 2, v + 2]);
    }
  }
}
// Controls above the chart, scale bars, north arrow and sites.
function takeFurniture(room) {
  const [w, h] = [view.w - 2 * view.spare, view.h - 2 * view.spare];
  const take = box => room.take(box.map(at => at + view.spare));
  for (const id of ["tools", "legend"]) {
    const box = el(id);
    take([box.offsetLeft - 2, box.offsetTop - 2, box.offsetLeft + box.offsetWidth + 2, box.offsetTop + box.offsetHeight + 2]);
  }
  take([w - 54, 4, w - 14, 76]); // the compass
  take([w - 20 - Math.min(150, w / 3.4), h - 64, w, h - 20]); // the scale bars
  if (el("credit").offsetWidth) take([w - el("credit").offsetWidth - 8, h - 22, w, h]);
  data.sensors.forEach((sensor, k) => {
    const site = siteOf(sensor);
    if (!site || !shown.source[k]) return;
    const [u, v] = toScreen(...site),
      half = 3.2 * sensor.name.length;
    room.take([u - half, v - 8, u + half, v + 22]);
  });
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
  if (isAmbiguous(d.r)) return 2;
  return objects.stage[d.r] === STAGE.confirmed ? 3 : 4;
}
function labelInk(d) {
  if (now.alarmed.has(d.n)) return colour.alarm;
  if (isAmbiguous(d.r)) return colour.warn;
  return objects.stage[d.r] === STAGE.tentative ? colour.dim : colour.ink;
}
// Draws the lines of a label at the first free place around the symbol; returns its box, or undefined.
function placed(c, room, d, lines, w) {
  const wide = Math.max(...lines.map(t => textWidth(c, t))) + 4;
  const high = LINE_HEIGHT * lines.length;
  const spot = spotsAround(wide, high)
    .map(([u, v]) => [d.u + u, d.v + v, d.u + u + wide, d.v + v + high])
    .find(box => box[0] > 2 && box[2] < w - 2 && room.free(box));
  if (!spot) return undefined;
  c.lineWidth = 3.5;
  c.strokeStyle = colour.halo;
  lines.forEach((t, k) => {
    const v = spot[1] + LINE_HEIGHT * (k + 0.5);
    c.strokeText(t, spot[0] + 2, v);
    c.fillStyle = k ? colour.dim : labelInk(d);
    c.fillText(t, spot[0] + 2, v);
  });
  return spot;
}
function* labels(c, w, drawn) {
  const named = drawn.filter(d => objects.stage[d.r] !== STAGE.ended).sort((a, b) => rank(a) - rank(b) || a.n - b.n);
  const room = takenRoom(),
    others = takenRoom(),
    withoutSymbols = takenRoom();
  takeFurniture(room);
  takeFurniture(withoutSymbols);
  takeSymbols(room, drawn);
  yield;
  c.font = "12px system-ui, 'DejaVu Sans', sans-serif";
  c.textBaseline = "middle";
  c.textAlign = "left";
  c.setLineDash([]);
  for (const [k, d] of named.entries()) {
    if (k % 40 === 39) yield;
    if (isMinor(d.r) && !textOf("o", "label", d.r)) continue;
    const name = nameOf(d.r).slice(0, 24);
    const full = Number.isFinite(objects.speed[d.r]) && (crowd.few || d.n === picked);
    const towards = Number.isFinite(courseOf(d.r)) ? course(courseOf(d.r)) : "";
    const moving = [knots(objects.speed[d.r]), towards, levelWords(d.r)].filter(Boolean).join(" ");
    // Labels of dots keep a distance, or they could not be assigned to their dots.
    if (!crowd.vectors && !isImportant(d.n) && !isApart(d) && !others.free([d.u - 92, d.v - 46, d.u + 92, d.v + 46])) continue;
    const box =
      (full && placed(c, room, d, [name, moving], w)) ||
      placed(c, room, d, [name], w) ||
      (rank(d) < 2 && placed(c, withoutSymbols, d, [name], w));
    if (box) for (const each of [others, room, withoutSymbols]) each.take(box);
  }
}
