// Shared by the pages of frames, series and movers: number formats, tables, and diagrams on a canvas.
"use strict";
const el = id => document.getElementById(id);
const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const colour = {};

// ---- light and dark: the reader's choice, else the setting of the system ----
const SCHEME = "sameas-theme";
function stored() { try { return localStorage.getItem(SCHEME); } catch { return null; } }
function themed(day) {
  document.documentElement.classList.toggle("day", day); el("theme").textContent = day ? "dark" : "light";
  for (const n of ["found", "alone", "lost", "odd", "east", "north", "ink", "dim", "line", "night", "bar", "grid"]) colour[n] = css("--" + n);
}
const isDay = () => document.documentElement.classList.contains("day");
themed((stored() ?? (window.matchMedia("(prefers-color-scheme: light)").matches ? "day" : "night")) === "day");
// redraw : called after the colours have changed.
function onTheme(redraw) {
  const turn = () => { themed(!isDay()); try { localStorage.setItem(SCHEME, isDay() ? "day" : "night"); } catch { /* a page from disk may have no store */ } redraw(); };
  el("theme").addEventListener("click", turn);
  document.addEventListener("keydown", e => { if ((e.key === "d" || e.key === "D") && !e.ctrlKey && !e.metaKey && !["INPUT", "SELECT"].includes(e.target.tagName)) turn(); });
}

// ---- formats ----
const fix = (v, n) => v === null || v === undefined || !isFinite(v) ? "–" : v.toFixed(n).replace(/^-(?=[0.]*$)/, "").replace("-", "−");
const grouped = n => String(n).replace(/\B(?=(\d{3})+(?!\d))/g, " ");
const probability = p => p === null ? "–" : p > 0.9999 ? "> 0.9999" : p < 1e-6 ? "< 0.000001" : p < 0.001 ? p.toExponential(1).replace("-", "−") : p.toFixed(4);
const hms = deg => { let t = Math.round(((deg / 15) % 24) * 36000) / 10; const h = Math.floor(t / 3600); t -= 3600 * h;
  const mi = Math.floor(t / 60); return `${String(h).padStart(2, "0")}ʰ${String(mi).padStart(2, "0")}ᵐ${(t - 60 * mi).toFixed(1).padStart(4, "0")}ˢ`; };
const dms = deg => { let t = Math.round(Math.abs(deg) * 3600); const d = Math.floor(t / 3600); t -= 3600 * d; const mi = Math.floor(t / 60);
  return `${deg < 0 ? "−" : "+"}${String(d).padStart(2, "0")}°${String(mi).padStart(2, "0")}′${String(t - 60 * mi).padStart(2, "0")}″`; };
const text = (tag, words, cls) => { const e = document.createElement(tag); e.textContent = words; if (cls) e.className = cls; return e; };
const table = (into, pairs) => { into.replaceChildren(...pairs.map(([a, b]) => { const tr = document.createElement("tr");
  tr.append(text("th", a), text("td", b)); return tr; })); };

function surface(canvas) {
  const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
    canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio);
  }
  const c = canvas.getContext("2d"); c.setTransform(ratio, 0, 0, ratio, 0, 0); c.clearRect(0, 0, w, h); return [c, w, h];
}

function axes(canvas, [x0, x1], [y0, y1], labelX, labelY, inY = fix) {
  const [c, w, h] = surface(canvas), left = 72, right = 12, top = 10, bottom = 34;
  const X = v => left + (v - x0) / (x1 - x0) * (w - left - right), Y = v => h - bottom - (v - y0) / (y1 - y0) * (h - top - bottom);
  c.font = "12px system-ui, sans-serif"; c.fillStyle = colour.dim; c.strokeStyle = colour.line; c.lineWidth = 1;
  const ticks = (a, b, n) => { const span = Math.abs(b - a), raw = span / n, p = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].map(f => f * p).find(f => f >= raw); const out = [];
    for (let t = Math.ceil(Math.min(a, b) / step) * step; t <= Math.max(a, b) + 1e-9; t += step) out.push([t, Math.max(0, -Math.floor(Math.log10(step) + 1e-9))]); return out; };
  c.textAlign = "center"; for (const [t, n] of ticks(x0, x1, 6)) { c.beginPath(); c.moveTo(X(t), top); c.lineTo(X(t), h - bottom); c.stroke(); c.fillText(fix(t, n), X(t), h - bottom + 15); }
  c.textAlign = "right"; for (const [t, n] of ticks(y0, y1, 5)) { c.beginPath(); c.moveTo(left, Y(t)); c.lineTo(w - right, Y(t)); c.stroke(); c.fillText(inY(t, n), left - 6, Y(t) + 4); }
  c.textAlign = "center"; c.fillText(labelX, (left + w - right) / 2, h - 4);
  if (labelY) { c.save(); c.translate(12, (top + h - bottom) / 2); c.rotate(-Math.PI / 2); c.fillText(labelY, 0, 0); c.restore(); }
  return [c, X, Y];
}
const range = (v, pad) => { const k = v.filter(x => x !== null && isFinite(x)); if (!k.length) return [0, 1];
  const a = Math.min(...k), b = Math.max(...k); return [a - pad * (b - a || 1), b + pad * (b - a || 1)]; };
const dots = (c, points, X, Y, fill) => { c.fillStyle = fill; c.globalAlpha = 0.6; for (const [x, y] of points) { c.beginPath(); c.arc(X(x), Y(y), points.length > 200 ? 1.6 : 3, 0, 7); c.fill(); } c.globalAlpha = 1; };
