// ---- conversion between the plane of the map and the earth (WGS84), as in sameas.tracks.coordinates ----
const A = 6378137,
  B = 6356752.314245179,
  E2 = 1 - (B / A) ** 2,
  RAD = Math.PI / 180;
const earth =
  data.origin &&
  (() => {
    const onEarth = (lat, lon) => {
      const n = A / Math.sqrt(1 - E2 * Math.sin(lat) ** 2);
      return [n * Math.cos(lat) * Math.cos(lon), n * Math.cos(lat) * Math.sin(lon), n * (1 - E2) * Math.sin(lat)];
    };
    const [lat0, lon0] = data.origin.map(v => v * RAD),
      o = onEarth(lat0, lon0);
    const east = [-Math.sin(lon0), Math.cos(lon0), 0];
    const north = [-Math.sin(lat0) * Math.cos(lon0), -Math.sin(lat0) * Math.sin(lon0), Math.cos(lat0)];
    const up = [Math.cos(lat0) * Math.cos(lon0), Math.cos(lat0) * Math.sin(lon0), Math.sin(lat0)];
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    // [x, y], or null on the far side of the earth.
    const toPlane = (lat, lon) => {
      const p = onEarth(lat * RAD, lon * RAD).map((v, k) => v - o[k]);
      return dot(p, up) < -4e6 ? null : [dot(p, east), dot(p, north)];
    };
    // [lat, lon] below a point of the plane, or null if there is none.
    const toEarth = (x, y) => {
      const above = o.map((v, k) => v + x * east[k] + y * north[k]),
        w = [1 / A ** 2, 1 / A ** 2, 1 / B ** 2];
      const sum = (p, q) => p.reduce((s, v, k) => s + v * q[k] * w[k], 0);
      const a = sum(up, up),
        b = sum(above, up),
        c = sum(above, above) - 1,
        root = b * b - a * c;
      if (root < 0) return null;
      const h = -c / (b + Math.sqrt(root)),
        p = above.map((v, k) => v + h * up[k]);
      return [Math.atan2(p[2], (1 - E2) * Math.hypot(p[0], p[1])) / RAD, Math.atan2(p[1], p[0]) / RAD];
    };
    // Direction of true north at a place, degrees clockwise from the plane's north.
    const north_at = (x, y) => {
      const g = toEarth(x, y);
      if (!g || Math.abs(g[0]) > 89.99) return 0;
      const p = toPlane(g[0] - 0.001, g[1]),
        q = toPlane(g[0] + 0.001, g[1]);
      return Math.atan2(q[0] - p[0], q[1] - p[1]) / RAD;
    };
    return { toPlane, toEarth, north: north_at };
  })();

function angleWords(deg, marks, width, digits) {
  const unit = 60 * 10 ** digits,
    total = Math.round(Math.abs(deg) * unit),
    whole = Math.floor(total / unit);
  const minutes = (total - whole * unit) / 10 ** digits;
  return `${String(whole).padStart(width, "0")}°${minutes.toFixed(digits).padStart(digits ? digits + 3 : 2, "0")}′${marks[deg < 0 ? 1 : 0]}`;
}
const latitude = (deg, digits = 3) => angleWords(deg, "NS", 2, digits);
const longitude = (deg, digits = 3) => angleWords(((deg + 540) % 360) - 180, "EW", 3, digits);
function placeWords(x, y) {
  if (!Number.isFinite(x) || !Number.isFinite(y)) return "not known";
  const g = earth && earth.toEarth(x, y);
  return g ? `${latitude(g[0])}  ${longitude(g[1])}` : `x ${fix(x, 1)} m  y ${fix(y, 1)} m`;
}
// True bearing and distance from one place of the plane to another.
function bearingRange(from, to) {
  const turn = earth ? earth.north(...from) : 0,
    dx = to[0] - from[0],
    dy = to[1] - from[1];
  return [(((Math.atan2(dx, dy) / RAD - turn) % 360) + 360) % 360, Math.hypot(dx, dy)];
}

const STEPS = [
  30,
  20,
  10,
  5,
  2,
  1,
  1 / 2,
  1 / 3,
  1 / 6,
  1 / 12,
  1 / 30,
  1 / 60,
  1 / 120,
  1 / 300,
  1 / 600,
  1 / 1200,
  1 / 3000,
  1 / 6000,
  1 / 30000,
  1 / 60000,
];
const digitsOf = step => (step >= 1 / 60 ? 0 : step >= 1 / 600 ? 1 : step >= 1 / 6000 ? 2 : 3);
// The graticule over a part of the plane: { points, words, parallel } per line.
function graticule(west, south, east, north, apart) {
  const lats = [],
    lons = [],
    middle = earth.toEarth((west + east) / 2, (south + north) / 2);
  if (!middle) return [];
  for (let i = 0; i <= 6; i++)
    for (let j = 0; j <= 6; j++) {
      const g = earth.toEarth(west + ((east - west) * i) / 6, south + ((north - south) * j) / 6);
      if (g) {
        lats.push(g[0]);
        lons.push(((((g[1] - middle[1]) % 360) + 540) % 360) - 180);
      }
    }
  const pole = [-90, 90].find(lat => {
    const p = earth.toPlane(lat, 0);
    return p && p[0] > west && p[0] < east && p[1] > south && p[1] < north;
  });
  const [low, high] = [Math.min(...lats), Math.max(...lats)].map((v, k) =>
    pole !== undefined && (k ? pole > 0 : pole < 0) ? pole : v,
  );
  const [first, last] = pole !== undefined ? [-180, 179.9] : [Math.min(...lons), Math.max(...lons)];
  const wanted = apart / 111195,
    cos = Math.max(Math.cos(middle[0] * RAD), 0.03);
  const up = [...STEPS].reverse().find(s => s >= wanted) || 30,
    across = [...STEPS].reverse().find(s => s * cos >= wanted) || 30;
  const lines = [],
    line = (parallel, value, from, to, words) => {
      const points = [];
      for (let k = 0; k <= 48; k++) {
        const v = from + ((to - from) * k) / 48,
          p = parallel ? earth.toPlane(value, v) : earth.toPlane(v, value);
        if (p) points.push(p);
      }
      lines.push({ points, words, parallel });
    };
  const cap = pole === undefined ? 0 : 0.5,
    base = middle[1];
  for (let v = Math.ceil(low / up) * up; v <= high; v += up)
    if (Math.abs(v) < 89.99)
      line(true, v, base + first, base + last + (pole === undefined ? 0 : 0.1), latitude(v, digitsOf(up)));
  for (let v = Math.ceil((base + first) / across) * across; v <= base + last; v += across)
    line(false, v, Math.max(low, -90 + cap), Math.min(high, 90 - cap), longitude(v, digitsOf(across)));
  return lines;
}
