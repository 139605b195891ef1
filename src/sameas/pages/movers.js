(() => {
const data = JSON.parse(document.getElementById("data").textContent);
let mover = null, frame = 0, playing = true, images = {}, timer = null;
const reducedMotion = window.matchMedia("(prefers-reduced-motion: reduce)").matches; playing = !reducedMotion;
// Images are dark in both themes: marks on them are light.
const onImage = { found: "#2f9bff", alone: "#ffe14a", dim: "#a9adb5", ink: "#ffffff" };
const clock = mjd => { const s = Math.round((mjd % 1) * 86400) % 86400; return `${String(Math.floor(s / 3600)).padStart(2, "0")}:${String(Math.floor(s / 60) % 60).padStart(2, "0")}:${String(s % 60).padStart(2, "0")}`; };
const date = mjd => new Date(Math.round((mjd - 40587) * 86400) * 1000).toISOString().slice(0, 10);
const scientific = p => { if (p >= 1e-3) return fix(p, 4); const [m, k] = p.toExponential(0).split("e"); return p > 0 ? `${m}·10${k.replace(/./g, d => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".indexOf(d)])}` : "0"; };
const ratio = r => fix(r, r < 100 ? 1 : 0);
const named = m => m.known ? m.known.name : m.name;
const mode = () => el("fixed").checked && mover.fixed ? "fixed" : "along";
function load(sheet) { const image = new Image(); image.src = "data:image/png;base64," + sheet.png; return image; }

function tile(canvas, image, size, number, magnified) {
  const [c, w, h] = surface(canvas), side = Math.min(w, h);
  c.imageSmoothingEnabled = magnified; c.fillStyle = "#000000"; c.fillRect(0, 0, w, h);
  if (image.complete && image.naturalWidth) c.drawImage(image, number * size, 0, size, size, (w - side) / 2, (h - side) / 2, side, side);
  return [c, (w - side) / 2, (h - side) / 2, side / size];
}
function mark(c, x, y, r, fill, dashed) { c.strokeStyle = fill; c.lineWidth = 1.5; c.setLineDash(dashed ? [3, 4] : []); c.beginPath(); c.arc(x, y, r, 0, 7); c.stroke(); c.setLineDash([]); }
function bar(c, left, top, zoom, size, arcsec) { // a scale in the lower right corner
  const step = [1, 2, 5, 10, 20, 30, 60, 120].filter(v => v / arcsec < size / 3).pop() || 1, x = left + size * zoom - 12, y = top + size * zoom - 12;
  c.strokeStyle = c.fillStyle = onImage.ink; c.lineWidth = 2; c.beginPath(); c.moveTo(x, y); c.lineTo(x - step / arcsec * zoom, y); c.stroke();
  c.font = "12px system-ui, sans-serif"; c.textAlign = "right"; c.fillText(`${step}″`, x, y - 6);
}
function compass(c, left, top) { // north and east in the upper left corner
  const x = left + 34, y = top + 36; c.strokeStyle = c.fillStyle = onImage.ink; c.lineWidth = 1.5; c.beginPath(); c.moveTo(x - 18, y); c.lineTo(x, y); c.lineTo(x, y - 18); c.stroke();
  c.font = "12px system-ui, sans-serif"; c.textAlign = "center"; c.fillText("N", x, y - 22); c.fillText("E", x - 25, y + 4);
}
function paint() {
  if (!mover) return;
  const m = mover, kind = mode(), sheet = m[kind], f = m.frames[frame];
  let [c, left, top, zoom] = tile(el("blink"), images[kind], sheet.size, frame, true);
  const [u, v] = kind === "along" ? [(sheet.size - 1) / 2, (sheet.size - 1) / 2] : f.at, x = left + (u + 0.5) * zoom, y = top + (v + 0.5) * zoom;
  if (el("marks").checked && f.flux !== null) mark(c, x, y, Math.max(8, data.width * 1.6 * zoom), f.detected ? onImage.found : f.hidden ? onImage.dim : onImage.alone, !f.detected);
  bar(c, left, top, zoom, sheet.size, m.scale); compass(c, left, top);
  el("blink-words").textContent = `${f.name}: ${f.flux === null ? "not on this frame" : f.detected ? "detected" : f.hidden ? "hidden by a star" : "not detected; the ring is where it is predicted"}`;
  el("when").textContent = `${frame + 1}/${m.frames.length}  ${clock(f.mjd)} UTC`; el("frame").value = frame;
  [c, left, top, zoom] = tile(el("stack"), images.stack, m.stack.size, 0, true);
  if (el("marks").checked) mark(c, left + m.stack.size / 2 * zoom, top + m.stack.size / 2 * zoom, Math.max(8, data.width * 1.6 * zoom), onImage.found, true);
  bar(c, left, top, zoom, m.stack.size, m.scale); compass(c, left, top);
}
function step(by) { frame = (frame + by + mover.frames.length) % mover.frames.length; paint(); }
function play(on) { playing = on; el("play").textContent = on ? "pause" : "play"; clearInterval(timer); if (on) timer = setInterval(() => step(1), 550); }

function diagrams() {
  if (!mover) return;
  const m = mover, t = m.frames.map(f => 1440 * (f.mjd - m.frames[0].mjd)), span = range(t, 0.05);
  const seen = m.rows, limits = seen.flatMap(r => [r.east - r.sigma, r.east + r.sigma, r.north - r.sigma, r.north + r.sigma]);
  let [c, X, Y] = axes(el("residuals"), span, range(limits, 0.08), "minutes since the first frame", "residual [″]");
  const bars = (key, fill) => { c.strokeStyle = fill; c.lineWidth = 1.2; for (const r of seen) { const x = 1440 * (r.mjd - m.frames[0].mjd); c.beginPath(); c.moveTo(X(x), Y(r[key] - r.sigma)); c.lineTo(X(x), Y(r[key] + r.sigma)); c.stroke(); } dots(c, seen.map(r => [1440 * (r.mjd - m.frames[0].mjd), r[key]]), X, Y, fill); };
  bars("east", colour.east); bars("north", colour.north);
  const points = m.frames.map((f, k) => [t[k], f.flux, f.error, f]).filter(p => p[1] !== null);
  [c, X, Y] = axes(el("light"), span, range([0, ...points.flatMap(p => [p[1] - p[2], p[1] + p[2]])], 0.08), "minutes since the first frame", "signal to noise of a typical frame");
  for (const [x, y, e, f] of points) { c.strokeStyle = c.fillStyle = f.detected ? colour.found : f.hidden ? colour.dim : colour.alone; c.lineWidth = 1.2; c.beginPath(); c.moveTo(X(x), Y(y - e)); c.lineTo(X(x), Y(y + e)); c.stroke(); c.beginPath(); c.arc(X(x), Y(y), 3.5, 0, 7); c.fill(); }
}
function record() {
  const m = mover;
  el("name").textContent = named(m); el("name").className = m.known ? "found" : "alone";
  table(el("numbers"), [["probability", probability(m.p)], ["expected by chance", scientific(m.chance)],
    ["detected on", m.added ? `none of ${m.frames.length} frames by itself` : `${m.rows.length} of ${m.frames.length} frames`], ["motion", `${fix(m.rate, 3)} ″/min towards ${fix(m.angle, 1)}°`],
    ["place", `${hms(m.rows[0].ra)} ${dms(m.rows[0].dec)}`], ["at", `${date(m.rows[0].mjd)} ${clock(m.rows[0].mjd)} UTC`], [data.scale.startsWith("instrumental") ? "magnitude, instrumental" : "magnitude", fix(m.magnitude, 2)], ["scatter about the motion", `${fix(m.scatter, 3)}″`],
    ["stacked signal to noise", ratio(m.snr)],
    ...(m.known ? [["is", `${m.known.name}, p ${probability(m.known.p)}`], ["observed − computed", `${fix(m.known.east, 2)}″ east, ${fix(m.known.north, 2)}″ north`], ["predicted V", fix(m.known.v, 1)]] : [["known", data.asked ? "none of the objects given" : "no elements were given"]]),
    ...(m.report === true ? [["report", `included as ${m.name}`]] : m.report === false ? [["report", "excluded: not probable enough"]] : [])]);
  el("reasons").replaceChildren(...m.reasons.map(([words, doubtful]) => text("li", words, doubtful ? "doubt" : "")));
  const head = document.createElement("tr"); head.append(...["UTC", "right ascension", "declination", "magnitude", "p of it", "east ″", "north ″", "frame"].map((w, k) => text("th", w, k > 2 && k < 7 ? "number" : "")));
  el("rows").replaceChildren(head, ...m.rows.map(r => { const tr = document.createElement("tr"), n = w => text("td", w, "number");
    tr.append(text("td", clock(r.mjd)), text("td", fix(r.ra, 6)), text("td", fix(r.dec, 6)), n(fix(r.magnitude, 2)), n(probability(r.p)), n(fix(r.east, 3)), n(fix(r.north, 3)), text("td", r.frame)); return tr; }));
}
function show(m) {
  mover = m; frame = 0; for (const id of ["mover", "diagrams-of", "table-of"]) el(id).hidden = false;
  images = Object.fromEntries(["fixed", "along", "stack"].filter(k => m[k]).map(k => [k, load(m[k])]));
  for (const image of Object.values(images)) image.addEventListener("load", paint);
  el("frame").max = m.frames.length - 1; el("fixed").disabled = !m.fixed; (m.fixed ? el("fixed") : el("along")).checked = true;
  el("stack-words").textContent = `All frames along the motion, signal to noise ${ratio(m.snr)}`;
  for (const b of el("list").children) b.className = b.dataset.name === m.name ? "on" : "";
  record(); diagrams(); paint(); play(playing); if (location.hash.slice(1) !== m.name) history.replaceState(null, "", "#" + m.name);
}
el("about").textContent = data.about;
el("list").replaceChildren(...data.movers.map(m => { const b = text("button", named(m) + " "); b.dataset.name = m.name;
  b.append(text("small", `p ${probability(m.p)} · ${m.added ? "stacked" : m.rows.length + " frames"} · ${fix(m.rate, 2)} ″/min`)); b.addEventListener("click", () => show(m)); return b; }));
el("play").addEventListener("click", () => play(!playing)); el("frame").addEventListener("input", () => { play(false); frame = +el("frame").value; paint(); });
for (const id of ["fixed", "along", "marks"]) el(id).addEventListener("change", paint);
el("blink").addEventListener("keydown", e => { if (e.key === " ") play(!playing); else if (e.key === "ArrowRight") { play(false); step(1); } else if (e.key === "ArrowLeft") { play(false); step(-1); } else return; e.preventDefault(); });
window.addEventListener("resize", () => { paint(); diagrams(); }); onTheme(() => { paint(); diagrams(); });
const first = data.movers.find(m => m.name === location.hash.slice(1)) || data.movers[0];
if (first) { show(first); Promise.all(Object.values(images).map(i => i.decode ? i.decode().catch(() => {}) : null)).then(() => { paint(); document.body.dataset.ready = "yes"; }); } else document.body.dataset.ready = "yes";
})();
