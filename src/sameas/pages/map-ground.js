// ---- background: land, grid, coverage, range rings, sites; foreground: scale bars, north arrow ----
const path = (lines, closed) => {
  const p = new Path2D();
  for (const line of lines) {
    for (let k = 0; k < line.length; k += 2) k ? p.lineTo(line[k], line[k + 1]) : p.moveTo(line[k], line[k + 1]);
    if (closed) p.closePath();
  }
  return p;
};
const landPath = path(data.land, true),
  coastPath = path(data.coast, false),
  borderPath = path(data.borders, false);

// The layer that the land is, where it is a chart of the user; it can be switched off.
let landLayer = null;

const ANTENNA = new Path2D("M0 7V-7M-6 7H6M-7-7Q0 1 7-7"),
  NORTH_ARROW = new Path2D("M0 20V-18M-5-9 0-18 5-9");

function ground(c, w, h) {
  c.setLineDash([]);
  c.fillStyle = colour.sea;
  c.fillRect(0, 0, w, h);
  c.save();
  c.translate(w / 2, h / 2);
  c.scale(view.scale, -view.scale);
  c.translate(-view.x, -view.y);
  if (landLayer === null || shown[landLayer]) land(c);
  c.setLineDash([6 / view.scale, 3 / view.scale]);
  c.strokeStyle = colour.border;
  c.stroke(borderPath);
  c.restore();
  c.setLineDash([]);
  for (const underlay of underlays) underlay(c, w, h);
  if (shown.grid) grid(c, w, h);
  if (shown.coverage) coverage(c);
  rings(c, w, h);
  sites(c);
}
function land(c) {
  c.fillStyle = colour.land;
  c.fill(landPath);
  c.lineWidth = 1 / view.scale;
  c.strokeStyle = colour.coast;
  c.stroke(coastPath);
}

const font = "11px system-ui, 'DejaVu Sans', sans-serif";
function haloed(c, words, u, v, ink = colour.dim) {
  c.lineWidth = 3;
  c.strokeStyle = colour.halo;
  c.strokeText(words, u, v);
  c.fillStyle = ink;
  c.fillText(words, u, v);
}
function grid(c, w, h) {
  const [west, north] = toMetres(0, 0),
    [east, south] = toMetres(w, h),
    apart = Math.min(150, w / 3) / view.scale;
  const lines = earth ? graticule(west, south, east, north, apart) : metreGrid(west, south, east, north, apart);
  c.font = font;
  c.textBaseline = "middle";
  for (const line of lines) {
    const points = line.points.map(p => toScreen(...p));
    c.lineWidth = 1;
    c.strokeStyle = colour.grid;
    c.beginPath();
    points.forEach(([u, v], k) => (k ? c.lineTo(u, v) : c.moveTo(u, v)));
    c.stroke();
    const edge = line.parallel ? w - 4 : 10; // parallels are labelled at the right, meridians at the top
    for (let k = 1; k < points.length; k++) {
      const [a, b] = [points[k - 1], points[k]],
        axis = line.parallel ? 0 : 1;
      if ((a[axis] - edge) * (b[axis] - edge) > 0 || a[axis] === b[axis]) continue;
      const s = (edge - a[axis]) / (b[axis] - a[axis]),
        u = a[0] + s * (b[0] - a[0]),
        v = a[1] + s * (b[1] - a[1]);
      c.textAlign = line.parallel ? "right" : "center";
      // Not where the compass and the scale bars are.
      if (line.parallel ? v > 100 && v < h - 70 : u > 90 && u < w - 90)
        haloed(c, line.words, u, line.parallel ? v - 7 : v);
      break;
    }
  }
}
function metreGrid(west, south, east, north, apart) {
  const step = nice(apart * 1.6),
    lines = [];
  for (let v = Math.ceil(west / step) * step; v <= east; v += step)
    lines.push({
      points: [
        [v, south],
        [v, north],
      ],
      words: `x ${metreWords(v, step)}`,
      parallel: false,
    });
  for (let v = Math.ceil(south / step) * step; v <= north; v += step)
    lines.push({
      points: [
        [west, v],
        [east, v],
      ],
      words: `y ${metreWords(v, step)}`,
      parallel: true,
    });
  return lines;
}
const metreWords = (v, step) =>
  step >= 1000
    ? `${fix((Math.round(v / step) * step) / 1000, 0)} km`
    : `${fix(Math.round(v / step) * step, step < 1 ? 1 : 0)} m`;

// Where a sensor is at the instant shown; one aboard a vessel moves. Null where that is not known.
const siteOf = sensor => (sensor.sites ? sensor.sites[now.k] : sensor.site);

function coverage(c) {
  data.sensors.forEach((sensor, k) => {
    const site = siteOf(sensor);
    if (!site || !sensor.range || !shown.source[k]) return;
    const [u, v] = toScreen(...site),
      far = sensor.range * view.scale,
      near = sensor.nearest * view.scale;
    if (far > 40000) return;
    for (const [from, to] of sensor.visible) {
      const a = (from - 90) * RAD,
        b = (to - 90) * RAD,
        full = to - from >= 359.99;
      c.beginPath();
      c.arc(u, v, far, a, b);
      if (full) c.moveTo(u + near * Math.cos(b), v + near * Math.sin(b));
      c.arc(u, v, near, b, a, true);
      c.closePath();
      c.globalAlpha = 0.05;
      c.fillStyle = colourOf(k);
      c.fill();
      c.globalAlpha = 0.6;
      c.lineWidth = 1;
      c.strokeStyle = colourOf(k);
      c.setLineDash([8, 5]);
      c.stroke();
      c.setLineDash([]);
      c.globalAlpha = 1;
    }
  });
}
function sites(c) {
  data.sensors.forEach((sensor, k) => {
    const site = siteOf(sensor);
    if (!site || !shown.source[k]) return;
    const [u, v] = toScreen(...site);
    c.setLineDash([]);
    c.strokeStyle = colour.halo;
    c.lineWidth = 5;
    c.save();
    c.translate(u, v);
    strokeOnHalo(c, ANTENNA, colourOf(k), 2, 5);
    c.restore();
    c.font = font;
    c.textAlign = "center";
    c.textBaseline = "middle";
    haloed(c, sensor.name, u, v + 16, colourOf(k));
  });
}

// The origin of range rings, bearings and ranges; further ones by the value of the choice: their words, and the place.
const centres = {};
function centreName() {
  const chosen = el("ring").value;
  return chosen in centres ? centres[chosen].words : data.sensors[+chosen].name;
}
function ringCentre() {
  const chosen = el("ring").value;
  if (chosen in centres) return centres[chosen].place();
  if (chosen === "object") {
    const row = picked !== null && now.rowOf.get(picked);
    return row !== false && row !== undefined && Number.isFinite(objects.x[row])
      ? [objects.x[row], objects.y[row]]
      : null;
  }
  return chosen === "" ? null : siteOf(data.sensors[+chosen]);
}
const RINGS = [0.1, 0.25, 0.5, 1, 2, 3, 6, 12, 24, 48, 96];
function rings(c, w, h) {
  const middle = ringCentre();
  if (!middle) return;
  const [u, v] = toScreen(...middle),
    wanted = Math.min(w, h) / 7 / view.scale;
  const step =
    nautical && wanted > 0.08 * MILE ? (RINGS.find(n => n * MILE >= wanted) || 96) * MILE : nice(wanted * 1.8);
  c.setLineDash([]);
  c.font = font;
  c.textAlign = "center";
  c.textBaseline = "middle";
  for (let k = 1; k <= 6; k++) {
    c.globalAlpha = 0.7;
    c.lineWidth = 1;
    c.strokeStyle = colour["cover-line"];
    c.beginPath();
    c.arc(u, v, k * step * view.scale, 0, 7);
    c.stroke();
    c.globalAlpha = 1;
    const label = v - k * step * view.scale;
    if (label > 20)
      haloed(c, nautical && step >= 0.1 * MILE ? `${+((k * step) / MILE).toFixed(2)} nm` : metres(k * step), u, label);
  }
}

function furniture(c, w, h) {
  scaleBar(c, w, h);
  compass(c, w);
}
function scaleBar(c, w, h) {
  const most = Math.min(150, w / 3.4),
    right = w - 16,
    low = h - 28;
  const bars = [[nice(most / view.scale), m => metres(m).replace(/\.0+ /, " ")]];
  const mile = nice(most / view.scale / MILE);
  if (nautical && mile >= 0.05) bars.push([mile * MILE, m => `${+(m / MILE).toPrecision(3)} nm`]);
  c.setLineDash([]);
  c.font = font;
  c.textAlign = "right";
  c.textBaseline = "alphabetic";
  bars.forEach(([length, words], k) => {
    const v = low - 22 * k,
      left = right - length * view.scale;
    strokeOnHalo(c, new Path2D(`M${left} ${v - 4}V${v}H${right}V${v - 4}`), colour.ink, 1.8, 5);
    haloed(c, words(length), right - 3, v - 5, colour.ink);
  });
}
function compass(c, w) {
  const turn = earth ? earth.north(view.x, view.y) * RAD : 0;
  c.save();
  c.translate(w - 34, 46);
  c.rotate(turn);
  c.setLineDash([]);
  strokeOnHalo(c, NORTH_ARROW, colour.ink, 1.6, 5);
  c.font = "bold 12px system-ui, 'DejaVu Sans', sans-serif";
  c.textAlign = "center";
  c.textBaseline = "middle";
  haloed(c, "N", 0, -27, colour.ink);
  c.restore();
}
