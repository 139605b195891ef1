"use strict";
(() => {
const data = JSON.parse(document.getElementById("data").textContent);
const m = data.measured, s = data.stars, summary = data.summary;
const [rows, columns] = data.shape;
// Rows of measurements: identified, not in the catalogue, fainter than its limit; and rows of missing stars.
const found = [], alone = [], lost = [], beyond = m.beyond, isBeyond = new Set(beyond);
m.x.forEach((_, i) => { if (m.star[i] !== null) found.push(i); else if (!isBeyond.has(i)) alone.push(i); });
s.missing.forEach((is, k) => { if (is) lost.push(k); });

// ---- the frame ----
const sky = el("sky"), picture = el("picture");
const view = { x: (columns - 1) / 2, y: (rows - 1) / 2, scale: 1, least: 1 };
let picked = null, pending = false;
const show = Object.fromEntries(["found", "alone", "beyond", "lost", "odd", "arrows", "grid"].map(n => [n, el("show-" + n)]));
const toScreen = (x, y) => [(x - view.x) * view.scale + sky.clientWidth / 2, (view.y - y) * view.scale + sky.clientHeight / 2];
const toPixel = (u, v) => [(u - sky.clientWidth / 2) / view.scale + view.x, view.y - (v - sky.clientHeight / 2) / view.scale];
const fit = () => { view.least = Math.min(sky.clientWidth / columns, sky.clientHeight / rows); };
const draw = () => { if (!pending) { pending = true; requestAnimationFrame(() => { pending = false; paint(); }); } };
const radius = i => { const step = Math.min(Math.max(faintest - (m.inst[i] ?? faintest), 0), 7); return data.width_px * (1.6 + 0.38 * step); };
const inOrder = m.inst.filter(v => v !== null).sort((a, b) => a - b), faintest = inOrder[Math.floor(0.9 * inOrder.length)] ?? 0;

function paint() {
  const [c, w, h] = surface(sky);
  c.fillStyle = colour.night; c.fillRect(0, 0, w, h);
  const wide = picture.naturalWidth * data.bin, high = picture.naturalHeight * data.bin;
  const [u, v] = toScreen(-0.5, -0.5 + high);
  c.imageSmoothingEnabled = view.scale * data.bin < 3;
  c.drawImage(stretched ?? picture, u, v, wide * view.scale, high * view.scale);
  const labels = show.grid.checked ? graticule(c, w, h) : [];
  const inside = (x, y, r) => x > -r && x < w + r && y > -r && y < h + r;
  c.lineWidth = 1.15;
  // Small marks while a whole frame is shown on a small screen, or they would hide it.
  const least = Math.min(Math.max(4 * view.scale, 1.5), 3);
  if (show.found.checked) {
    c.strokeStyle = colour.found;
    for (const i of found.slice(0, +el("many").value)) {
      const [x, y] = toScreen(m.x[i], m.y[i]), r = Math.max(radius(i) * view.scale, least);
      if (!inside(x, y, r)) continue;
      c.setLineDash(m.rivals[i].some(e => e[5] && e[1] < 0.9) ? [2, 3] : []);
      c.beginPath(); c.arc(x, y, r, 0, 7); c.stroke();
    }
    c.setLineDash([]);
  }
  if (show.alone.checked) {
    c.strokeStyle = colour.alone; c.beginPath();
    const r = Math.max(least, Math.min(1.3 * data.width_px * view.scale, 12));
    for (const i of alone) {
      const [x, y] = toScreen(m.x[i], m.y[i]);
      if (inside(x, y, r)) { c.moveTo(x - r, y - r); c.lineTo(x + r, y + r); c.moveTo(x - r, y + r); c.lineTo(x + r, y - r); }
    }
    c.stroke();
  }
  if (show.beyond.checked) {
    c.fillStyle = colour.alone;
    for (const i of beyond) { const [x, y] = toScreen(m.x[i], m.y[i]); if (inside(x, y, 2)) c.fillRect(x - 1, y - 1, 2, 2); }
  }
  if (show.lost.checked) {
    c.strokeStyle = colour.lost; c.beginPath();
    const r = Math.max(1.3 * least, Math.min(1.6 * data.width_px * view.scale, 15));
    for (const k of lost) {
      const [x, y] = toScreen(s.x[k], s.y[k]);
      if (inside(x, y, r)) { c.moveTo(x - r, y); c.lineTo(x, y - r); c.lineTo(x + r, y); c.lineTo(x, y + r); c.closePath(); }
    }
    c.stroke();
  }
  if (show.odd.checked) {
    c.strokeStyle = colour.odd; c.lineWidth = 1.6; c.beginPath();
    for (const i of data.odd) { const [x, y] = toScreen(m.x[i], m.y[i]), r = Math.max(radius(i) * view.scale, least) + 3; if (inside(x, y, r)) c.rect(x - r, y - r, 2 * r, 2 * r); }
    c.stroke();
  }
  if (show.arrows.checked) arrows(c);
  // Above the marks, or they would hide them.
  c.font = "12px ui-monospace, monospace"; c.fillStyle = colour.grid; c.strokeStyle = colour.night; c.lineWidth = 4;
  for (const label of labels) { c.strokeText(...label); c.fillText(...label); }
  if (picked) {
    const [x, y] = toScreen(...where(picked));
    c.strokeStyle = colour.ink; c.lineWidth = 2; c.beginPath(); c.arc(x, y, 17, 0, 7); c.stroke();
    if (picked.kind === "measured") rivalLines(c, picked.row);
  }
}
function arrows(c) {
  const grown = +el("grown").value, most = 0.045 * Math.max(columns, rows);
  c.strokeStyle = colour.odd; c.lineWidth = 1.2;
  // Arrows of outliers are cut short and dashed, so that they do not cover others.
  for (const cut of [false, true]) {
    c.setLineDash(cut ? [3, 3] : []); c.beginPath();
    for (const i of found) {
      const far = grown * Math.hypot(m.dx[i], m.dy[i]); if (far > most !== cut) continue;
      const f = cut ? grown * most / far : grown, [x, y] = toScreen(m.x[i], m.y[i]), [u, v] = toScreen(m.x[i] + f * m.dx[i], m.y[i] + f * m.dy[i]);
      const a = Math.atan2(v - y, u - x), l = Math.min(5, 0.4 * Math.hypot(u - x, v - y));
      c.moveTo(x, y); c.lineTo(u, v); if (cut) continue;
      c.lineTo(u - l * Math.cos(a - 0.5), v - l * Math.sin(a - 0.5)); c.moveTo(u, v); c.lineTo(u - l * Math.cos(a + 0.5), v - l * Math.sin(a + 0.5));
    }
    c.stroke();
  }
  c.setLineDash([]);
}
function showCut() {
  const grown = +el("grown").value, most = 0.045 * Math.max(columns, rows), cut = found.filter(i => grown * Math.hypot(m.dx[i], m.dy[i]) > most).length;
  el("cut").textContent = cut && show.arrows.checked ? `${grouped(cut)} longer ones are cut short and dashed` : "";
}

// ---- intensity stretch: a table of 256 grey values, applied to the image once per change ----
let shades = null, stretched = null;
function stretch() {
  const black = +el("black").value, white = Math.max(+el("white").value, black + 5), power = 2 ** (-+el("middle").value / 50), negative = el("negative").checked;
  if (!black && white === 255 && power === 1 && !negative) { stretched = null; draw(); return; }
  const w = picture.naturalWidth, h = picture.naturalHeight;
  if (!shades) { const o = document.createElement("canvas"); o.width = w; o.height = h; const oc = o.getContext("2d"); oc.drawImage(picture, 0, 0);
    const all = oc.getImageData(0, 0, w, h).data; shades = new Uint8Array(w * h); for (let k = 0; k < shades.length; k++) shades[k] = all[4 * k]; }
  const table = new Uint32Array(256);
  for (let k = 0; k < 256; k++) { const v = Math.round(255 * Math.min(Math.max((k - black) / (white - black), 0), 1) ** power), g = negative ? 255 - v : v; table[k] = (255 << 24 | g << 16 | g << 8 | g) >>> 0; }
  stretched ??= Object.assign(document.createElement("canvas"), { width: w, height: h });
  const c = stretched.getContext("2d"), image = c.createImageData(w, h), px = new Uint32Array(image.data.buffer);
  for (let k = 0; k < px.length; k++) px[k] = table[shades[k]];
  c.putImageData(image, 0, 0); draw();
}

// ---- pixels to sky by the plate model, (ξ, η) = Σ c uᵃ vᵇ on the tangent plane (METHOD of the plate) ----
const plate = summary.plate, RAD = Math.PI / 180, ARC = 3600 / RAD;
const powers = []; for (let n = 0; n <= plate.order; n++) for (let b = 0; b <= n; b++) powers.push([n - b, b]);
const ra0 = plate.tangent_ra_deg * RAD, dec0 = plate.tangent_dec_deg * RAD, [s0, c0] = [Math.sin(dec0), Math.cos(dec0)];
function toPlane(x, y) {
  const u = (x - plate.middle_px[0]) / plate.unit_px, v = (y - plate.middle_px[1]) / plate.unit_px; let e = 0, n = 0, eu = 0, ev = 0, nu = 0, nv = 0;
  powers.forEach(([a, b], k) => { const [p, q] = [plate.coefficients_arcsec[0][k], plate.coefficients_arcsec[1][k]], t = u ** a * v ** b;
    const tu = a ? a * u ** (a - 1) * v ** b : 0, tv = b ? b * u ** a * v ** (b - 1) : 0;
    e += p * t; n += q * t; eu += p * tu; ev += p * tv; nu += q * tu; nv += q * tv; });
  return [e / ARC, n / ARC, eu / ARC, ev / ARC, nu / ARC, nv / ARC];
}
function toSky(x, y) {
  const [e, n] = toPlane(x, y), d = c0 - n * s0;
  return [((ra0 + Math.atan2(e, d)) / RAD + 720) % 360, Math.atan2(s0 + n * c0, Math.hypot(e, d)) / RAD];
}
function fromSky(ra, dec) {
  const d = ra * RAD - ra0, t = dec * RAD, z = Math.sin(t) * s0 + Math.cos(t) * c0 * Math.cos(d); if (z < 0.05) return null;
  const e = Math.cos(t) * Math.sin(d) / z, n = (Math.sin(t) * c0 - Math.cos(t) * s0 * Math.cos(d)) / z;
  let x = plate.middle_px[0], y = plate.middle_px[1];
  for (let k = 0; k < 12; k++) { const [a, b, eu, ev, nu, nv] = toPlane(x, y), det = eu * nv - ev * nu, fe = e - a, fn = n - b;
    const du = (fe * nv - fn * ev) / det, dv = (fn * eu - fe * nu) / det; x += Math.min(Math.max(du, -2), 2) * plate.unit_px; y += Math.min(Math.max(dv, -2), 2) * plate.unit_px;
    if (Math.hypot(du, dv) < 1e-7) return [x, y]; if (Math.hypot(x - columns / 2, y - rows / 2) > 8 * (columns + rows)) return null; }
  return null;
}
const DEC_STEPS = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 18000, 36000, 108000].map(v => v / 3600);
const RA_STEPS = [0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800].map(v => v / 240);
const two = n => String(n).padStart(2, "0");
function raWords(deg, step) { const t = Math.round(((deg + 720) % 360) * 2400) / 10, h = Math.floor(t / 3600), mi = Math.floor((t - 3600 * h) / 60), se = t - 3600 * h - 60 * mi;
  return `${two(h)}ʰ${two(mi)}ᵐ` + (step * 240 < 60 ? (step * 240 < 1 ? se.toFixed(1).padStart(4, "0") : two(Math.round(se))) + "ˢ" : ""); }
function decWords(deg, step) { const t = Math.round(Math.abs(deg) * 3600), d = Math.floor(t / 3600), mi = Math.floor(t / 60) % 60; return (deg < 0 ? "−" : "+") + two(d) + "°" + (step < 1 ? two(mi) + "′" : "") + (step < 1 / 60 ? two(t % 60) + "″" : ""); }
function graticule(c, w, h) {
  const at = []; for (let k = 0; k <= 8; k++) for (let l = 0; l <= 8; l++) at.push(toSky(...toPixel(w * k / 8, h * l / 8)));
  const middle = toSky(...toPixel(w / 2, h / 2))[0], off = at.map(([ra]) => (ra - middle + 540) % 360 - 180), decs = at.map(p => p[1]);
  let [d0, d1] = [Math.min(...decs), Math.max(...decs)], [r0, r1] = [Math.min(...off), Math.max(...off)];
  for (const pole of [90, -90]) { const p = fromSky(0, pole); if (!p) continue; const [u, v] = toScreen(...p); if (u > 0 && u < w && v > 0 && v < h) { r0 = -180; r1 = 180; if (pole > 0) d1 = 90; else d0 = -90; } }
  const wide = Math.max(2, w / 190), high = Math.max(2, h / 150);
  const decStep = DEC_STEPS.find(v => (d1 - d0) / v <= high) ?? 30, raStep = RA_STEPS.find(v => (r1 - r0) / v <= wide) ?? 45;
  c.strokeStyle = colour.grid; c.lineWidth = 0.8; c.globalAlpha = 0.6;
  const labels = [];
  const line = (points, words, edge) => {
    let last = null, named = false; c.beginPath();
    for (const p of points) { const s = p && toScreen(...p); if (s && last) { c.moveTo(...last); c.lineTo(...s);
        // The label is where the line leaves the image: at the lower edge, or at the left one.
        const crosses = edge === "below" ? (last[1] - (h - 26)) * (s[1] - (h - 26)) <= 0 : (last[0] - 6) * (s[0] - 6) <= 0;
        if (crosses && !named) { const f = edge === "below" ? (h - 26 - last[1]) / (s[1] - last[1] || 1) : (6 - last[0]) / (s[0] - last[0] || 1), x = last[0] + f * (s[0] - last[0]), y = last[1] + f * (s[1] - last[1]);
          if (x > -1 && x < w - 60 && y > 60 && y < h - 20) { labels.push([words, x + 4, y - 4]); named = true; } } }
      last = s; }
    c.stroke();
  };
  const steps = (a, b) => Array.from({ length: 33 }, (_, k) => a + (b - a) * k / 32);
  for (let r = Math.ceil((middle + r0) / raStep) * raStep; r <= middle + r1 + 1e-9; r += raStep) line(steps(Math.max(d0 - decStep, -89.99), Math.min(d1 + decStep, 89.99)).map(d => fromSky(r, d)), raWords(r, raStep), "below");
  for (let d = Math.ceil(d0 / decStep) * decStep; d <= d1 + 1e-9; d += decStep) if (Math.abs(d) < 90) line(steps(middle + r0 - raStep, middle + r1 + raStep).map(r => fromSky(r, d)), decWords(d, decStep), "left");
  c.globalAlpha = 1;
  return labels;
}
function rivalLines(c, i) {
  const [x, y] = toScreen(m.x[i], m.y[i]);
  c.setLineDash([3, 3]); c.lineWidth = 1;
  for (const [k] of m.rivals[i]) { const [u, v] = toScreen(s.x[k], s.y[k]);
    c.beginPath(); c.moveTo(x, y); c.lineTo(u, v); c.stroke(); c.beginPath(); c.arc(u, v, 2.5, 0, 7); c.stroke(); }
  c.setLineDash([]);
}
const where = p => p.kind === "measured" ? [m.x[p.row], m.y[p.row]] : [s.x[p.row], s.y[p.row]];
function zoom(factor, u = sky.clientWidth / 2, v = sky.clientHeight / 2) {
  const [x, y] = toPixel(u, v);
  view.scale = Math.min(Math.max(view.scale * factor, view.least), 60);
  view.x = x - (u - sky.clientWidth / 2) / view.scale; view.y = y + (v - sky.clientHeight / 2) / view.scale;
  clampView(); draw();
}
function clampView() { view.x = Math.min(Math.max(view.x, 0), columns - 1); view.y = Math.min(Math.max(view.y, 0), rows - 1); }
function whole() { fit(); view.scale = view.least; view.x = (columns - 1) / 2; view.y = (rows - 1) / 2; draw(); }

function nearest(u, v) {
  let best = null, least = 16;
  const look = (kind, row, x, y, room) => { const [a, b] = toScreen(x, y), d = Math.hypot(a - u, b - v) - room;
    if (d < least) { least = d; best = { kind, row }; } };
  if (show.found.checked) for (const i of found.slice(0, +el("many").value)) look("measured", i, m.x[i], m.y[i], 0);
  if (show.alone.checked) for (const i of alone) look("measured", i, m.x[i], m.y[i], 0);
  if (show.beyond.checked) for (const i of beyond) look("measured", i, m.x[i], m.y[i], 0);
  if (show.lost.checked) for (const k of lost) look("star", k, s.x[k], s.y[k], 0);
  return best;
}
function pick(p, centre) {
  picked = p;
  if (p && centre) { [view.x, view.y] = where(p); view.scale = Math.max(view.scale, 4 * view.least, 3); clampView(); }
  record(); draw();
}

// ---- the selected record ----
function record() {
  const box = el("record"); box.replaceChildren();
  if (!picked) { box.append(text("p", "Click a mark to see what it is, and what else it might be.", "hint")); return; }
  if (picked.kind === "star") missing(box, picked.row); else measured(box, picked.row);
}
function starFacts(k) {
  const moved = Math.hypot(s.east[k], s.north[k]);
  return [["star", s.id[k]], ["position", `${hms(s.ra[k])} ${dms(s.dec[k])}`], ["magnitude", fix(s.mag[k], 2)],
    ...(s.tint[k] === null ? [] : [[data.colour, fix(s.tint[k], 2)]]),
    ...(moved > 0.0005 ? [["moved", `${fix(s.east[k], 2)}″ east, ${fix(s.north[k], 2)}″ north`]] : [])];
}
function measured(box, i) {
  const k = m.star[i];
  box.append(text("h2", k === null ? "Not in the catalogue" : s.id[k], k === null ? "alone" : "found"));
  if (isBeyond.has(i)) box.append(text("p", "It is fainter than the catalogue reaches here.", "hint"));
  if (data.odd.includes(i)) box.append(text("p", `Identified, but ${oddWords(i)}.`, "odd-words"));
  const chosen = m.rivals[i].find(e => e[5]);
  const facts = document.createElement("table");
  table(facts, [["is this star", k === null ? "none: " + probability(m.none[i]) : probability(chosen[1])],
    ...(k === null ? [] : [["residual", `${fix(m.de[i], 3)}″ east, ${fix(m.dn[i], 3)}″ north; ${fix(m.chi[i], 1)} σ`], ...starFacts(k).slice(1)])]);
  box.append(facts, text("h3", "Candidates"));
  const rivals = document.createElement("table"); rivals.className = "rivals";
  const head = document.createElement("tr"); head.append(...["star", "mag", "px", "σ", "probability"].map(t => text("th", t)));
  rivals.append(head);
  for (const [star, p, dx, dy, chi, is] of m.rivals[i]) {
    const tr = document.createElement("tr"); if (is) tr.className = "chosen";
    tr.append(text("td", s.id[star]), text("td", fix(s.mag[star], 2)), text("td", fix(Math.hypot(dx, dy), 2)), text("td", fix(chi, 1)), text("td", probability(p)));
    rivals.append(tr);
  }
  const none = document.createElement("tr"); none.className = k === null ? "none chosen" : "none";
  none.append(text("td", "none of them"), text("td", ""), text("td", ""), text("td", ""), text("td", probability(m.none[i])));
  rivals.append(none); box.append(rivals, text("h3", `Measurement ${i}`));
  const own = document.createElement("table");
  table(own, [["pixel", `${fix(m.x[i], 2)} ± ${fix(m.sx[i], 3)}, ${fix(m.y[i], 2)} ± ${fix(m.sy[i], 3)}`],
    ["position", `${hms(m.ra[i])} ${dms(m.dec[i])}`], ["", `${fix(m.ra[i], 6)}°, ${fix(m.dec[i], 6)}°`],
    ["magnitude", fix(m.mag[i], 2)], ["significance", fix(m.snr[i], 1)], ["width", m.fwhm[i] === null ? "–" : fix(m.fwhm[i], 2) + " px"],
    ["flags", m.words[m.flags[i]] || "none"]]);
  box.append(own);
}
const oddWords = i => `${fix(Math.abs(m.excess[i]), 1)} mag ${m.excess[i] < 0 ? "brighter" : "fainter"} than catalogued`;
function oddList() {
  const box = el("odd-list"); box.hidden = !data.odd.length; el("n-odd").textContent = grouped(data.odd.length);
  box.querySelector("summary").textContent = `${grouped(data.odd.length)} brighter or fainter than catalogued`;
  for (const i of data.odd) { const b = text("button", `${s.id[m.star[i]]}: ${oddWords(i)}${m.words[m.flags[i]] ? ` (${m.words[m.flags[i]]})` : ""}`); b.addEventListener("click", () => pick({ kind: "measured", row: i }, true)); box.append(b); }
}
function missing(box, k) {
  box.append(text("h2", s.id[k], "lost"), text("p", "Missing: " + s.why[k] + "."));
  const facts = document.createElement("table");
  table(facts, [...starFacts(k).slice(1), ["pixel", `${fix(s.x[k], 2)}, ${fix(s.y[k], 2)}`], ["completeness", `${fix(100 * s.shown[k], 0)} % of stars so bright`]]);
  box.append(facts);
  const rivals = m.rivals.flatMap((list, i) => list.filter(e => e[0] === k).map(e => [i, e]));
  if (!rivals.length) return;
  box.append(text("h3", "Measurements that might be it"));
  const t = document.createElement("table");
  table(t, rivals.map(([i, e]) => [`measurement ${i}`, `${probability(e[1])}, ${fix(Math.hypot(e[2], e[3]), 2)} px away`]));
  box.append(t);
}
function search() {
  const wanted = el("search").value.trim(); if (!wanted) return;
  const k = s.id.findIndex(id => id === wanted), part = k >= 0 ? k : s.id.findIndex(id => id.endsWith(wanted));
  if (k >= 0 || (part >= 0 && !(/^\d+$/.test(wanted) && +wanted < m.x.length))) {
    const at = k >= 0 ? k : part;
    pick(s.owner[at] === null ? { kind: "star", row: at } : { kind: "measured", row: s.owner[at] }, true);
  } else if (/^\d+$/.test(wanted) && +wanted < m.x.length) pick({ kind: "measured", row: +wanted }, true);
  else el("record").replaceChildren(text("p", `No star or measurement “${wanted}” on this page.`, "hint"));
}

// ---- diagrams ----
let byMagnitude = null;
function diagrams() {
  const bright = i => s.mag[m.star[i]] ?? null, known = found.filter(i => bright(i) !== null);
  const list = known.length > 2 ? known : found, value = known.length > 2 ? bright : i => m.inst[i];
  const scatter = summary.residuals.scatter_arcsec.map(v => v ?? 1), limit = 5 * Math.max(...scatter, 1e-4);
  const name = known.length > 2 ? "magnitude" : "instrumental magnitude";
  const clip = v => Math.min(Math.max(v, -limit), limit);
  let [c, X, Y] = axes(el("by-magnitude"), range(list.map(value), 0.03), [-1.05 * limit, 1.05 * limit], name, "measured − catalogue [″]");
  dots(c, list.map(i => [value(i), clip(m.de[i])]), X, Y, colour.east); dots(c, list.map(i => [value(i), clip(m.dn[i])]), X, Y, colour.north);
  const clipped = list.filter(i => Math.max(Math.abs(m.de[i]), Math.abs(m.dn[i])) > limit).length;
  el("clipped").textContent = clipped ? `; at the edge: ${grouped(clipped)} beyond ± ${fix(limit, limit < 0.1 ? 3 : 2)}″` : "";
  byMagnitude = { list, points: i => [[X(value(i)), Y(clip(m.de[i]))], [X(value(i)), Y(clip(m.dn[i]))]] };
  const zero = summary.brightness.zero_point;
  el("zero").textContent = zero ? zero.words + (data.odd.length ? `; dark: ${grouped(data.odd.length)} brighter or fainter than catalogued` : "") : "no magnitudes to compare";
  el("magnitudes").hidden = !zero;
  if (zero) {
    // The zero point by each star: on magnitudes against each other, a scatter of hundredths is not visible.
    const line = data.relation.filter(([x, y]) => x !== null && y !== null).map(([x, y]) => [y, y - x]), centre = line[line.length >> 1][1];
    const high = Math.max(12 * zero.scatter_mag, 0.1, 1.2 * Math.max(...line.map(([, y]) => Math.abs(y - centre))));
    const each = i => centre + Math.min(Math.max(bright(i) - m.inst[i] - centre, -0.98 * high), 0.98 * high);
    const outside = known.filter(i => Math.abs(bright(i) - m.inst[i] - centre) > high).length;
    if (outside) el("zero").textContent += `; at the edge: ${grouped(outside)} beyond ± ${fix(high, 2)} mag`;
    const ends = range(known.map(bright), 0.03);
    [c, X, Y] = axes(el("magnitudes"), ends, [centre - high, centre + high], "magnitude", "catalogue − instrumental [mag]");
    dots(c, known.map(i => [bright(i), each(i)]), X, Y, colour.east); dots(c, data.odd.filter(i => bright(i) !== null).map(i => [bright(i), each(i)]), X, Y, colour.odd);
    c.strokeStyle = colour.north; c.lineWidth = 2; c.beginPath();
    line.filter(([x]) => x > ends[0] && x < ends[1]).forEach(([x, y], k) => k ? c.lineTo(X(x), Y(y)) : c.moveTo(X(x), Y(y))); c.stroke();
  }
  const curve = summary.brightness.completeness;
  el("shown").textContent = curve ? curve.words : "the catalogue has no magnitudes";
  el("complete").hidden = !curve;
  if (curve) {
    const e = curve.edges_mag; [c, X, Y] = axes(el("complete"), [e[0], e[e.length - 1]], [0, 1.2 * Math.max(...curve.stars, 1)], "magnitude", "stars on the frame");
    curve.stars.forEach((n, k) => { const x = X(e[k]), w = X(e[k + 1]) - x - 1;
      c.fillStyle = colour.bar; c.fillRect(x, Y(n), w, Y(0) - Y(n)); c.fillStyle = colour.found; c.fillRect(x, Y(curve.found[k]), w, Y(0) - Y(curve.found[k])); });
    const top = 1.2 * Math.max(...curve.stars, 1); c.strokeStyle = c.fillStyle = colour.north; c.lineWidth = 1.2;
    curve.stars.forEach((n, k) => { if (!n) return; const x = X((e[k] + e[k + 1]) / 2), f = curve.found[k] / n, y = v => Y(v * top / 1.2);
      c.beginPath(); c.arc(x, y(f), 2.6, 0, 7); c.fill(); c.beginPath(); c.moveTo(x, y(f - curve.sigma[k])); c.lineTo(x, y(Math.min(1.05, f + curve.sigma[k]))); c.stroke(); });
    c.textAlign = "right"; c.fillText("points: share identified; dashed: 100 %", el("complete").clientWidth - 16, 22);
    c.setLineDash([4, 4]); c.beginPath(); c.moveTo(X(e[0]), Y(top / 1.2)); c.lineTo(X(e[e.length - 1]), Y(top / 1.2)); c.stroke(); c.setLineDash([]);
  }
}

// ---- facts ----
// The same quantity as in the report: the median residual over that expected from the quoted errors.
function errorWords() {
  const scale = summary.estimated && summary.estimated.error_scale;
  return scale ? `the median residual is ${fix(scale[0], 2)} ± ${fix(scale[1], 2)} times that of the quoted errors` : `${fix(summary.found.typical_error_scale, 2)} times those quoted`;
}
function facts() {
  const p = summary.place, r = summary.residuals, f = summary.found, plate = summary.plate;
  const angle = d => d >= 1 ? fix(d, 2) + "°" : d >= 1 / 60 ? fix(60 * d, 1) + "′" : fix(3600 * d, 1) + "″";
  el("about").textContent = `${hms(p.middle_ra_deg)} ${dms(p.middle_dec_deg)} · ${angle(p.width_deg)} × ${angle(p.height_deg)} · ${fix(p.scale_arcsec_per_px, 4)}″ per pixel`
    + (summary.exposure && summary.exposure.mid_time ? ` · ${summary.exposure.mid_time}` : "") + ` · ${data.catalogue}`;
  el("n-found").textContent = grouped(found.length); el("n-alone").textContent = grouped(alone.length); el("n-beyond").textContent = grouped(beyond.length); el("beyond").hidden = !beyond.length; el("n-lost").textContent = grouped(lost.length);
  table(el("plate"), [["placed by", `${p.found_by}, odds ${p.odds}; next best ${p.next_best_odds}`], ["order", `${plate.order} (BIC ${Object.entries(plate.bic).map(([o, v]) => `${o}: ${fix(v, 0)}`).join(", ")})`],
    ["residuals, robust 1σ", `${fix(r.scatter_arcsec[0], 3)}″ east, ${fix(r.scatter_arcsec[1], 3)}″ north`], ["rms", `${fix(r.rms_arcsec[0], 3)}″, ${fix(r.rms_arcsec[1], 3)}″`],
    ...(plate.error_scale > 1.005 ? [["errors of the terms", `${fix(plate.error_scale, 2)} times what the quoted errors give, as the residuals are`]] : []),
    ...(plate.floor_arcsec ? [["floor of the errors", `${plate.floor_arcsec.toPrecision(2)}″ per axis, as bright stars are off by more than their errors`]] : []), ["y axis", `${fix(p.rotation_deg, 3)}° (north through east), ${p.mirrored ? "mirrored" : "not mirrored"}`],
    ["tangent point", `${fix(plate.tangent_ra_deg, 6)}°, ${fix(plate.tangent_dec_deg, 6)}°`]]);
  const names = []; for (let n = 0; n <= plate.order; n++) for (let b = 0; b <= n; b++) names.push(n === 0 ? "1" : `${n - b ? "u" + (n - b > 1 ? "²³⁴⁵"[n - b - 2] : "") : ""}${b ? "v" + (b > 1 ? "²³⁴⁵"[b - 2] : "") : ""}`);
  const line = (cells, tag) => { const tr = document.createElement("tr"); tr.append(...cells.map(t => text(tag, t))); return tr; };
  el("terms").replaceChildren(line(["term", "ξ east [″]", "σ", "η north [″]", "σ"], "th"), ...names.map((n, k) =>
    line([n, fix(plate.coefficients_arcsec[0][k], 4), fix(plate.coefficients_sigma_arcsec[0][k], 4), fix(plate.coefficients_arcsec[1][k], 4), fix(plate.coefficients_sigma_arcsec[1][k], 4)], "td")));
  table(el("counts"), [["measurements", grouped(f.measurements)], ["stars on the frame", grouped(f.stars_on_frame)], ["identified", grouped(f.identified)], ["expected wrong", fix(f.expected_wrong, 1)],
    ["with probability below 0.9", grouped(f.ambiguous)], ["not in the catalogue", grouped(f.unidentified) + (f.beyond_catalogue ? `, ${grouped(f.beyond_catalogue)} of them fainter than its limit` : "")], ["missing", grouped(f.missing)], ["gate", fix(f.gate_sigmas, 1) + " quoted σ"], ["errors", errorWords()]]);
  el("notes").replaceChildren(...[...(summary.exposure ? summary.exposure.read : []), ...summary.notes].map(n => text("li", n, /^(doubt|assumed)/.test(n) ? "doubt" : "")));
  const many = el("many"); many.max = found.length; many.value = Math.min(data.brightest ?? found.length, found.length);
  const showCount = () => { el("n-many").textContent = grouped(+many.value); }; showCount(); many.addEventListener("input", () => { showCount(); draw(); });
  const lengths = found.map(i => Math.hypot(m.dx[i], m.dy[i])).sort((a, b) => a - b), typical = lengths[Math.floor(0.7 * lengths.length)] || 1;
  const ideal = 0.02 * columns / typical, steps = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000];
  el("grown").replaceChildren(...steps.map(n => { const o = text("option", String(n)); o.value = n; return o; }));
  el("grown").value = steps.filter(n => n <= ideal).pop() || 1; showCut(); oddList();
}

// ---- input ----
let drag = null;
sky.addEventListener("wheel", e => { e.preventDefault(); zoom(Math.exp(-0.0016 * e.deltaY), e.offsetX, e.offsetY); }, { passive: false });
sky.addEventListener("pointerdown", e => { drag = { u: e.offsetX, v: e.offsetY, x: view.x, y: view.y, moved: false }; sky.setPointerCapture(e.pointerId); });
sky.addEventListener("pointermove", e => {
  const [x, y] = toPixel(e.offsetX, e.offsetY), [ra, dec] = toSky(x, y);
  el("place").textContent = `${hms(ra)} ${dms(dec)}   ${fix(ra, 5)}° ${fix(dec, 5)}°   x ${fix(x, 1)} y ${fix(y, 1)}`;
  if (!drag) return;
  if (Math.hypot(e.offsetX - drag.u, e.offsetY - drag.v) > 4) drag.moved = true;
  if (drag.moved) { view.x = drag.x - (e.offsetX - drag.u) / view.scale; view.y = drag.y + (e.offsetY - drag.v) / view.scale; clampView(); draw(); }
});
sky.addEventListener("pointerup", e => { if (drag && !drag.moved) pick(nearest(e.offsetX, e.offsetY), false); drag = null; });
sky.addEventListener("dblclick", e => zoom(2, e.offsetX, e.offsetY));
sky.addEventListener("keydown", e => { if (e.key === "+" || e.key === "=") zoom(1.5); else if (e.key === "-") zoom(1 / 1.5); else if (e.key === "0") whole();
  else if (e.key.startsWith("Arrow")) { const d = 60 / view.scale; view.x += { ArrowLeft: -d, ArrowRight: d }[e.key] || 0; view.y += { ArrowUp: d, ArrowDown: -d }[e.key] || 0; clampView(); draw(); e.preventDefault(); } });
el("closer").addEventListener("click", () => zoom(1.6)); el("farther").addEventListener("click", () => zoom(1 / 1.6)); el("whole").addEventListener("click", whole);
for (const id of ["grown", "show-arrows"]) el(id).addEventListener("change", () => { showCut(); draw(); });
for (const id of ["black", "middle", "white"]) el(id).addEventListener("input", stretch);
el("negative").addEventListener("change", stretch);
// In the light theme stars are black on white.
onTheme(() => { el("negative").checked = isDay(); stretch(); record(); diagrams(); });
el("negative").checked = isDay(); for (const box of Object.values(show)) box.addEventListener("change", draw);
el("search").addEventListener("change", search);
el("by-magnitude").addEventListener("click", e => { let best = null, least = 8; for (const i of byMagnitude.list) for (const [u, v] of byMagnitude.points(i)) {
  const d = Math.hypot(u - e.offsetX, v - e.offsetY); if (d < least) { least = d; best = i; } } if (best !== null) { pick({ kind: "measured", row: best }, true); sky.scrollIntoView({ block: "nearest" }); } });
window.addEventListener("resize", () => { const was = view.least; fit(); if (view.scale <= was * 1.001) whole(); draw(); diagrams(); });
facts();
(picture.decode ? picture.decode() : Promise.resolve()).catch(() => {}).then(() => { stretch(); whole(); diagrams(); document.body.dataset.ready = "yes"; });
window.framePage = { toScreen, toPixel, toSky, fromSky, view, pick };
})();
