(() => {
const data = JSON.parse(document.getElementById("data").textContent);
let field = data.fields[0] ?? null, chosen = -1, marks = [];
const cell = (tag, words, cls) => text(tag, words, cls), minutes = t => 1440 * (t - field.frames[0].mjd);
const clock = mjd => { const s = Math.round((mjd % 1) * 86400); return `${String(Math.floor(s / 3600)).padStart(2, "0")}:${String(Math.floor(s / 60) % 60).padStart(2, "0")}:${String(s % 60).padStart(2, "0")}`; };
const day = mjd => new Date((mjd - 40587) * 86400000).toISOString().slice(0, 10);

function frames() {
  const head = document.createElement("tr");
  head.append(...["frame", "middle, UTC", "measured", "identified", "missing", "zero point", "excess scatter", "star width", "doubts"].map((w, k) => cell("th", w, k > 1 && k < 8 ? "number" : "")));
  const rows = (field ? field.frames : []).map(f => { const tr = document.createElement("tr"), first = document.createElement("td");
    if (f.page) { const a = document.createElement("a"); a.href = encodeURIComponent(f.page); a.append(text("bdi", f.name)); first.append(a); } else first.append(text("bdi", f.name));
    first.title = f.name;
    const number = w => cell("td", w, "number");
    tr.append(first, cell("td", clock(f.mjd)), number(grouped(f.measured)), number(grouped(f.identified)), number(grouped(f.missing)),
      number(f.zero === null ? "–" : `${fix(f.zero, 3)} ± ${fix(f.zero_err, 3)}`), number(`${f.below ? "≤ " : ""}${fix(f.scatter, 3)}″`), number(`${fix(f.width, 1)} px`), cell("td", f.doubts ? `${f.doubts}, below` : "none", f.doubts ? "doubt" : ""));
    return tr; });
  const failed = data.failed.map(([name, why]) => { const tr = document.createElement("tr"), words = cell("td", why); tr.className = "failed"; words.colSpan = 8; tr.append(cell("td", name), words); return tr; });
  el("frames").replaceChildren(head, ...rows, ...failed);
}
function bars(c, points, X, Y, fill) { c.strokeStyle = fill; c.lineWidth = 1.2; for (const [x, y, e] of points) { c.beginPath(); c.moveTo(X(x), Y(y - e)); c.lineTo(X(x), Y(y + e)); c.stroke(); } dots(c, points, X, Y, fill); }
function overTime(id, sets, label, down) {
  const t = field.frames.map(f => minutes(f.mjd)), limits = sets.flatMap(([points]) => points.flatMap(([, y, e]) => [y - (e || 0), y + (e || 0)]));
  const r = range(limits, 0.08), [c, X, Y] = axes(el(id), range(t, 0.04), down ? [r[1], r[0]] : r, "minutes since the first frame", label);
  for (const [points, fill] of sets) bars(c, points.map(([x, y, e]) => [x, y, e || 0]), X, Y, fill);
}
function series() {
  if (!field) return;
  const f = field.frames, s = field.stars, t = f.map(x => minutes(x.mjd));
  overTime("zero", [[f.map((x, k) => [t[k], x.zero, x.zero_err]).filter(p => p[1] !== null), colour.found]], "zero point [mag]");
  el("zero-words").textContent = `Zero point of each frame from ${grouped(Math.max(...f.map(x => x.ensemble)))} stars, scale ${field.scale}; bright stars scatter by ${fix(field.floor, 4)} mag more than their errors`;
  overTime("offsets", [[f.map((x, k) => [t[k], x.shift[0]]), colour.east], [f.map((x, k) => [t[k], x.shift[1]]), colour.north]], "shift [″]");
  const log = s.scatter.map(v => v === null ? null : Math.log10(Math.max(v, 1e-4)));
  const [c, X, Y] = axes(el("scatter"), range(s.mag, 0.03), range(log, 0.06), "magnitude", "scatter [mag]", t => String(Number((10 ** t).toPrecision(2))));
  marks = s.mag.map((m, k) => m === null || log[k] === null ? null : [X(m), Y(log[k])]);
  const one = (k, fill) => { if (!marks[k]) return; c.fillStyle = fill; c.beginPath(); c.arc(...marks[k], fill === colour.alone ? 4 : 2.6, 0, 7); c.fill(); };
  s.mag.forEach((_, k) => one(k, s.p[k] !== null && s.p[k] < 0.001 ? colour.alone : colour.east));
  if (chosen >= 0 && marks[chosen]) { c.strokeStyle = colour.ink; c.lineWidth = 2; c.beginPath(); c.arc(...marks[chosen], 9, 0, 7); c.stroke(); }
  const variable = s.p.filter(p => p !== null && p < 0.001).length;
  el("scatter-words").textContent = `${grouped(field.count)} stars${field.count > s.mag.length ? `, ${grouped(s.mag.length)} on this page, the brightest and most variable` : ""}; yellow: ${variable} that scatter as constant ones do less than once in a thousand`;
  star();
}
function star() {
  if (chosen < 0) return;
  const s = field.stars, k = chosen, f = field.frames, t = f.map(x => minutes(x.mjd)), box = el("star"), facts = document.createElement("table");
  table(facts, [["position", `${hms(s.ra[k])} ${dms(s.dec[k])}`], ["", `${fix(s.ra[k], 6)}°, ${fix(s.dec[k], 6)}°`], ["on", `${s.curve[k].filter(v => v !== null).length} of ${f.length} frames with a magnitude`],
    ["magnitude", fix(s.mag[k], 3)], ["scatter", `${fix(s.scatter[k], 4)} mag`], ["probability of this scatter if constant", probability(s.p[k])]]);
  box.replaceChildren(text("h2", s.id[k] || `star ${s.number[k]}, not in the catalogue`, s.id[k] ? "found" : "alone"), facts);
  overTime("curve", [[s.curve[k].map((v, n) => [t[n], v, s.err[k][n]]).filter(p => p[1] !== null), colour.found]], "magnitude", true);
  el("curve-words").textContent = `Light curve of ${s.id[k] || `star ${s.number[k]}`}`;
  overTime("residuals", [[s.de[k].map((v, n) => [t[n], v]).filter(p => p[1] !== null), colour.east], [s.dn[k].map((v, n) => [t[n], v]).filter(p => p[1] !== null), colour.north]], "residual [″]");
}
function notes() {
  const list = [...(field ? field.notes : []), ...data.reasons];
  el("notes").replaceChildren(...(list.length ? list : ["nothing"]).map(n => text("li", n, list.length ? "doubt" : "")));
}
function show(f) {
  field = f; const s = f ? f.stars : null; chosen = s && s.mag.length ? s.mag.reduce((best, m, k) => m !== null && (best < 0 || (s.p[k] ?? 1) < (s.p[best] ?? 1)) ? k : best, -1) : -1;
  el("about").textContent = f ? `${f.frames.length} frames${f.filter ? ` in ${f.filter}` : ""} on ${day(f.frames[0].mjd)}, ${clock(f.frames[0].mjd)} to ${clock(f.frames[f.frames.length - 1].mjd)} UTC · ${hms(f.middle[0])} ${dms(f.middle[1])} · ${grouped(f.count)} stars` : "no two frames of one field";
  el("fields").replaceChildren(...(data.fields.length > 1 ? data.fields.map(g => { const b = text("button", `${g.name}: ${g.frames.length} frames${g.filter ? ` in ${g.filter}` : ""}`, g === f ? "on" : ""); b.addEventListener("click", () => show(g)); return b; }) : []));
  frames(); series(); notes();
}
el("scatter").addEventListener("click", e => { let best = -1, least = 14; marks.forEach((p, k) => { if (!p) return; const d = Math.hypot(p[0] - e.offsetX, p[1] - e.offsetY); if (d < least) { least = d; best = k; } }); if (best >= 0) { chosen = best; series(); } });
window.addEventListener("resize", series); onTheme(series);
if (data.movers) { const a = document.createElement("a"); a.href = encodeURIComponent(data.movers.page); a.textContent = data.movers.words; el("movers").append(a); }
show(field); document.body.dataset.ready = "yes";
})();
