// ---- number formats of shipping and aviation ----
const KNOT = 1852 / 3600,
  MILE = 1852;
const fix = (v, n) => (Number.isFinite(v) ? v.toFixed(n).replace("-", "−") : "–");
const grouped = n => String(n).replace(/\B(?=(\d{3})+(?!\d))/g, " ");
const course = deg =>
  Number.isFinite(deg) ? String(Math.round(((deg % 360) + 360) % 360) % 360).padStart(3, "0") + "°" : "–";
const probability = p =>
  !Number.isFinite(p)
    ? "–"
    : p > 0.9999
      ? "> 0.9999"
      : p < 0.0001
        ? "< 0.0001"
        : p.toFixed(p > 0.995 || p < 0.005 ? 4 : 2);
// Near scenes are in metres, unless own ship is among them.
let nautical = data.extent[2] - data.extent[0] > 2 * MILE || data.extent[3] - data.extent[1] > 2 * MILE;
const metres = m =>
  m >= 10000
    ? `${fix(m / 1000, m < 99500 ? 1 : 0)} km`
    : m >= 1000
      ? `${fix(m / 1000, 2)} km`
      : m >= 10
        ? `${fix(m, 0)} m`
        : `${fix(m, 1)} m`;
const distance = m => (nautical && m >= 0.1 * MILE ? `${fix(m / MILE, m < 10 * MILE ? 2 : 1)} nm` : metres(m));
// Tenths of a knot are a ship's.
const inKnots = speed => fix(speed / KNOT, speed < 99.95 * KNOT ? 1 : 0);
const knots = speed => (Number.isFinite(speed) ? `${inKnots(speed)} kn` : "–");
// An object at rest has no meaningful course.
const courseOf = r => (objects.speed[r] < 0.05 * KNOT ? NaN : objects.course[r]);
// Flight levels, hundreds of feet, are of what has a transponder; rescue aircraft (AIS), gliders and drones send metres.
const hasLevel = r => !!(textOf("o", "icao", r) || textOf("o", "mode_a", r));
const CLIMBS_M_PER_S = 1.5;
function levelWords(r) {
  const m = objects.height[r],
    climb = objects.climb[r];
  if (!Number.isFinite(m)) return "";
  const level = hasLevel(r) ? `FL${String(Math.max(Math.round(m / 30.48), 0)).padStart(3, "0")}` : `${grouped(Math.round(m / 10) * 10)} m`;
  return level + (climb >= CLIMBS_M_PER_S ? "↑" : climb <= -CLIMBS_M_PER_S ? "↓" : "");
}
const plural = (n, word) => `${grouped(n)} ${word}${n === 1 ? "" : "s"}`;
const duration = s =>
  s < 60 ? `${+s.toFixed(1)} s` : s < 3600 ? `${+(s / 60).toFixed(1)} min` : `${+(s / 3600).toFixed(1)} h`;
// Durations offered in menus, seconds.
const PERIODS = [1, 2, 5, 10, 30, 60, 180, 360, 720, 1800, 3600, 7200, 21600];
const nice = most => {
  const p = 10 ** Math.floor(Math.log10(most));
  return Math.max(...[1, 2, 5].map(s => s * p).filter(v => v <= most * 1.0000001));
};

const shortest = data.instants.reduce(
  (least, t, k) => (k ? Math.min(least, t - data.instants[k - 1]) : least),
  Infinity,
);
// Ticks of a live page lie anywhere within a second.
const decimals =
  data.live && data.live.tick >= 1 ? 0 : shortest < 0.1 ? 2 : shortest < 1 || data.instants.some(t => Math.abs(t - Math.round(t)) > 0.001) ? 1 : 0;
function clock(t) {
  if (!data.utc) return [`${fix(t, decimals)} s`, ""];
  const unit = 10 ** decimals,
    d = new Date((Math.round(t * unit) / unit) * 1000 + 1e-3),
    two = n => String(n).padStart(2, "0");
  const part = decimals
    ? "." + String(Math.floor((d.getUTCMilliseconds() / 1000) * unit + 1e-6)).padStart(decimals, "0")
    : "";
  return [
    `${two(d.getUTCHours())}:${two(d.getUTCMinutes())}:${two(d.getUTCSeconds())}${part}`,
    `${d.getUTCFullYear()}-${two(d.getUTCMonth() + 1)}-${two(d.getUTCDate())}`,
  ];
}

const text = (tag, words, cls) => {
  const e = document.createElement(tag);
  e.textContent = words;
  if (cls) e.className = cls;
  return e;
};
const tableRow = (...cells) => {
  const tr = document.createElement("tr");
  tr.append(...cells);
  return tr;
};
function options(select, pairs, chosen) {
  select.replaceChildren(
    ...pairs.map(([value, words]) => {
      const o = text("option", words);
      o.value = value;
      return o;
    }),
  );
  select.value = String(chosen);
}
