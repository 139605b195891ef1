// ---- appearance: colours by day and night, marks of sources, symbols of objects ----
// After Okabe and Ito, darker by day and lighter by night: distinct for every colour vision. Orange and red are
// reserved for ambiguity and alarms.
const PALETTE = {
  day: ["#0067a5", "#007a58", "#a8407e", "#7a6200", "#5a45a8", "#2f8fc4", "#5c5c5c"],
  night: ["#5fb4f0", "#2fcf9b", "#f09ac6", "#d7d36a", "#b3a1ff", "#9fd8ff", "#bdbdbd"],
};
const MARKS = ["square", "diamond", "circle", "cross", "plus", "down", "bar"];
const colour = {};
let night = false;
function readColours() {
  const style = getComputedStyle(document.documentElement);
  for (const name of [
    "sea",
    "land",
    "coast",
    "border",
    "grid",
    "ink",
    "dim",
    "accent",
    "warn",
    "alarm",
    "halo",
    "cover",
    "cover-line",
    "old",
    "panel",
  ])
    colour[name] = style.getPropertyValue("--" + name).trim();
}
const colourOf = source => PALETTE[night ? "night" : "day"][source % PALETTE.day.length];
// Sources that report their own position (AIS, ADS-B) get the triangle, as AIS targets have on radars.
const markOf = (() => {
  const own = data.sensors.map(s => (/^(ais|ads-b)$/.test(s.kind) ? "triangle" : null));
  let used = 0;
  return own.map(m => m || MARKS[used++ % MARKS.length]);
})();
const shown = {
  source: data.sensors.map(() => true),
  records: true,
  tentative: true,
  ellipses: true,
  members: true,
  labels: true,
  coverage: true,
  grid: true,
};

// Outlines around (0, 0) of size 1, for the chart and for icons.
const OUTLINES = {
  square: "M-.85-.85h1.7v1.7h-1.7z",
  triangle: "M0-1.2 1 .8H-1z",
  down: "M0 1.2 1-.8H-1z",
  diamond: "M0-1.2 1.2 0 0 1.2-1.2 0z",
  circle: "M-1 0a1 1 0 1 0 2 0a1 1 0 1 0-2 0z",
  cross: "M-1-1 1 1M1-1-1 1",
  plus: "M-1.2 0h2.4M0-1.2v2.4",
  bar: "M-1.2 0h2.4",
};
const outlinePaths = Object.fromEntries(Object.entries(OUTLINES).map(([kind, d]) => [kind, new Path2D(d)]));
function outlineAt(kind, x, y, r) {
  const path = new Path2D();
  path.addPath(outlinePaths[kind], { a: r, d: r, e: x, f: y });
  return path;
}
// A line that is visible on any background: on a wider line in the background colour (none if its width is 0).
function strokeOnHalo(c, path, ink, wide, halo = wide + 2.5) {
  if (halo) {
    c.strokeStyle = colour.halo;
    c.lineWidth = halo;
    c.stroke(path);
  }
  c.strokeStyle = ink;
  c.lineWidth = wide;
  c.stroke(path);
}
function drawMark(c, source, x, y, r = 4) {
  c.setLineDash([]);
  strokeOnHalo(c, outlineAt(markOf[source], x, y, r), colourOf(source), 1.7, 3.4);
}

// Sprites: each kind of symbol is drawn once into its own canvas and copied from there. A frame of 500 objects with
// 800 records takes 34 ms of the processor without a graphics card if all are stroked, 22 ms with sprites and shared paths.
const sprites = new Map();
function sprite(key, half, drawAt) {
  const ratio = window.devicePixelRatio || 1,
    own = `${key} ${night} ${ratio}`;
  if (!sprites.has(own)) {
    const canvas = document.createElement("canvas");
    canvas.width = canvas.height = 2 * Math.ceil(half * ratio);
    const c = canvas.getContext("2d");
    c.setTransform(ratio, 0, 0, ratio, canvas.width / 2, canvas.width / 2);
    drawAt(c);
    sprites.set(own, canvas);
  }
  return sprites.get(own);
}
// Calls draw with a function that copies a sprite to a place, aligned to device pixels so that it stays sharp.
function withSprites(c, draw) {
  const ratio = window.devicePixelRatio || 1;
  c.save();
  c.setTransform(1, 0, 0, 1, 0, 0);
  draw((image, u, v) => c.drawImage(image, Math.round(u * ratio) - image.width / 2, Math.round(v * ratio) - image.width / 2));
  c.restore();
}
const markSprite = (source, r) => sprite(`mark ${source} ${r}`, 1.2 * r + 3, c => drawMark(c, source, 0, 0, r));
const symbolSprite = (stage, how) =>
  sprite(`object ${stage} ${how.several} ${how.ambiguous} ${how.alarmed} ${how.r}`, how.r + 14, c => drawSymbol(c, stage, 0, 0, how));

// Symbols of objects, similar to those of tracked radar targets (IMO SN.1/Circ.243): dashed while tentative, a circle
// when confirmed, crossed while coasting; a dot if two or more sources report it.
function symbolInk(stage, ambiguous, alarmed) {
  if (alarmed) return colour.alarm;
  if (ambiguous) return colour.warn;
  return stage === STAGE.confirmed ? colour.ink : colour.dim;
}
function drawSymbol(c, stage, x, y, { several = false, ambiguous = false, alarmed = false, r = 8 } = {}) {
  c.strokeStyle = c.fillStyle = symbolInk(stage, ambiguous, alarmed);
  c.setLineDash([]);
  c.lineWidth = 1.5;
  if (stage === STAGE.ended) return c.stroke(outlineAt("cross", x, y, 4));
  // In a crowd an object is a dot, pale unless confirmed.
  if (r < 4 && !ambiguous && !alarmed) {
    c.globalAlpha = stage === STAGE.confirmed ? 1 : 0.55;
    c.fill(outlineAt("circle", x, y, Math.max(r, 1.6)));
    c.globalAlpha = 1;
    return;
  }
  const ring = outlineAt("circle", x, y, r);
  c.save();
  c.strokeStyle = colour.halo;
  c.lineWidth = 4.5;
  c.stroke(ring);
  c.restore();
  c.setLineDash(stage === STAGE.tentative ? [3, 3.2] : []);
  c.lineWidth = stage === STAGE.confirmed ? 2 : 1.5;
  c.stroke(ring);
  c.setLineDash([]);
  if (stage === STAGE.coasting) c.stroke(outlineAt("cross", x, y, r * 0.7));
  else if (several) c.fill(outlineAt("circle", x, y, 2.4));
  if (ambiguous) drawDoubt(c, x, y, r);
  if (alarmed) drawAlarm(c, x, y, r);
}
function drawDoubt(c, x, y, r) {
  c.setLineDash([5, 3]);
  c.lineWidth = 1.6;
  c.strokeStyle = colour.warn;
  c.stroke(outlineAt("circle", x, y, r + 4));
  c.setLineDash([]);
}
function drawAlarm(c, x, y, r) {
  c.strokeStyle = colour.alarm;
  c.lineWidth = 2;
  c.stroke(new Path2D(`M${x} ${y - r - 10}L${x + r + 10} ${y + r + 4}H${x - r - 10}z`));
}
function drawCorners(c, x, y, r) {
  c.setLineDash([]);
  c.lineWidth = 2.2;
  c.strokeStyle = colour.accent;
  for (const u of [-r, r])
    for (const v of [-r, r]) {
      const [du, dv] = [6 * Math.sign(u), 6 * Math.sign(v)];
      c.stroke(new Path2D(`M${x + u} ${y + v - dv}V${y + v}H${x + u - du}`));
    }
}

// A canvas with a small drawing, for legends and tables.
function icon(size, paint) {
  const canvas = document.createElement("canvas"),
    ratio = window.devicePixelRatio || 1;
  canvas.width = canvas.height = Math.round(size * ratio);
  canvas.style.width = canvas.style.height = size + "px";
  canvas.setAttribute("aria-hidden", "true");
  const c = canvas.getContext("2d");
  c.scale(ratio, ratio);
  paint(c, size / 2);
  return canvas;
}
const SVG = "http://www.w3.org/2000/svg";
function sourceIcon(source) {
  const icon = document.createElementNS(SVG, "svg"),
    path = document.createElementNS(SVG, "path");
  icon.setAttribute("viewBox", "-1.7 -1.7 3.4 3.4");
  icon.setAttribute("class", "swatch");
  icon.setAttribute("aria-hidden", "true");
  path.setAttribute("d", OUTLINES[markOf[source]]);
  path.setAttribute("fill", "none");
  path.setAttribute("stroke", colourOf(source));
  path.setAttribute("stroke-width", "0.45");
  icon.append(path);
  return icon;
}
