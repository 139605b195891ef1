// ---- the panel of the selected object ----
const tag = (words, cls = "") => text("span", words, `tag ${cls}`);
const facts = pairs => {
  const t = document.createElement("table");
  t.append(...pairs.filter(p => p[1]).map(([a, b]) => tableRow(text("th", a), text("td", b))));
  return t;
};
const sourceCell = source => {
  const cell = document.createElement("td");
  cell.append(sourceIcon(source), data.sensors[source].name);
  return cell;
};
const recordWords = r =>
  `${data.sensors[records.source[r]].name} ${textOf("r", "track_id", r) || (records.line[r] >= 0 ? `line ${records.line[r]}` : `row ${records.row[r]}`)}`;

// Where explanations come from: this file, or the server of a live page.
let explain = whyText;
// What was last explained, shown until the explanation of a new instant is there.
let explained = { number: null, parts: [] };

async function showObject() {
  const box = el("object");
  if (picked === null) {
    box.hidden = true;
    box.replaceChildren();
    return;
  }
  const number = picked,
    instantShown = now.k,
    r = now.rowOf.get(number);
  const shut = text("button", "×", "close");
  shut.setAttribute("aria-label", "deselect the object");
  shut.addEventListener("click", () => pick(null));
  if (r === undefined) {
    const [first, last] = rowsOf.get(number);
    box.replaceChildren(
      shut,
      text("h2", nameOf(last)),
      text(
        "p",
        `Object ${number} is not in the picture at this time; it is from ${clock(data.instants[objects.t[first]])[0]} to ${clock(data.instants[objects.t[last]])[0]}.`,
        "hint",
      ),
    );
    box.hidden = false;
    return;
  }
  const why = document.createElement("div");
  if (explained.number === number) why.append(...explained.parts);
  box.replaceChildren(shut, text("h2", nameOf(r)), tags(r), facts(state(r)), ...membership(r), why);
  box.hidden = false;
  const explanation = await explain(number, instantShown);
  if (picked !== number || now.k !== instantShown) return;
  if (!explanation) {
    explained = { number: null, parts: [] };
    why.replaceChildren();
    return;
  }
  const since = explanation.at < instantShown ? `, as at ${clock(data.instants[explanation.at])[0]}` : "";
  explained = { number, parts: [text("h3", `Why${since}`), ...paragraphs(explanation.words)] };
  why.replaceChildren(...explained.parts);
}
// Lines of a table keep their columns, and scroll sideways; others wrap.
function paragraphs(words) {
  const parts = [];
  for (const line of words.replace(/\n$/, "").split("\n")) {
    const cls = /\S {2,}\S|^ {2,}\S/.test(line) ? "columns" : "";
    if (parts.length && parts[parts.length - 1].cls === cls) parts[parts.length - 1].lines.push(line);
    else parts.push({ cls, lines: [line] });
  }
  return parts.map(({ cls, lines }) => text("pre", lines.join("\n"), cls));
}
function tags(r) {
  const line = document.createElement("div");
  line.className = "tags";
  line.append(
    tag(`object ${numberOf(r)}`),
    tag(`track ${data.stages[objects.stage[r]]}`, objects.stage[r] === STAGE.coasting ? "warn" : ""),
    isSeveral(r) || objects.sources[r] < 2
      ? tag(objects.sources[r] ? plural(objects.sources[r], "source") : "no report now")
      : tag(`perhaps ${plural(objects.sources[r], "source")}`, "warn"),
  );
  if (objects.ambiguous[r]) line.append(tag("ambiguous", "warn"));
  if (now.alarmed.has(numberOf(r))) line.append(tag("alarm", "alarm"));
  return line;
}
function heightWords(r) {
  const height = objects.height[r],
    climb = objects.climb[r];
  if (!Number.isFinite(height)) return "";
  const going = Number.isFinite(climb) && Math.abs(climb) >= 0.5 ? `, ${climb > 0 ? "climbs" : "sinks"} ${fix(Math.abs(climb), 1)} m/s` : "";
  return `${grouped(Math.round(height))} m ± ${grouped(Math.round(2 * objects.sh[r]))} m${hasLevel(r) ? `  (${levelWords(r)})` : ""}${going}`;
}
function state(r) {
  const speed = objects.speed[r],
    from = ringCentre(),
    place = [objects.x[r], objects.y[r]],
    own = el("ring").value === "object";
  const [bearing, range] = from && !own ? bearingRange(from, place) : [];
  return [
    ["Position", placeWords(...place)],
    [
      "2σ",
      Number.isFinite(objects.major[r]) ? `${metres(2 * objects.major[r])} × ${metres(2 * objects.minor[r])}` : "",
    ],
    ["Speed", Number.isFinite(speed) ? `${knots(speed)}  (${fix(speed, 1)} m/s)` : ""],
    ["Course", Number.isFinite(courseOf(r)) ? course(courseOf(r)) : ""],
    ["Height", heightWords(r)],
    [
      from && !own ? `From ${centreName()}` : "",
      from && Number.isFinite(range) ? `${course(bearing)}  ${distance(range)}` : "",
    ],
    ...[
      ["Name", "name"],
      ["Callsign", "callsign"],
      ["MMSI", "mmsi"],
      ["ICAO", "icao"],
      ["Mode A", "mode_a"],
      ["Type", "type"],
    ].map(([label, key]) => [label, textOf("o", key, r)]),
    ...furtherFacts.flatMap(of => of(r)),
    ...data.alarms.filter(a => a.objects.includes(numberOf(r)) && isActive(a, now.k)).map(a => ["Alarm", a.text]),
  ];
}
function membership(r) {
  const own = now.members.get(numberOf(r)),
    parts = [];
  const one = own.length < 2 ? "This record is an object of its own" : isSeveral(r) ? "These records are one object" : "These records may be one object";
  parts.push(
    text(
      "h3",
      own.length
        ? `${one}: probability ${probability(objects.p[r])}`
        : objects.sources[r]
          ? `Seen by ${plural(objects.sources[r], "source")} then; records are kept for the present only`
          : "No current report; its position is predicted",
    ),
  );
  if (own.length) parts.push(memberTable(r, own));
  if (own.length && objects.rival[r] > 0.00001) {
    const rivals = rivalsOf(r),
      gone = own.filter(m => !rivals.includes(m)),
      more = rivals.filter(m => !own.includes(m));
    const change = [
      more.length ? "with " + more.map(recordWords).join(", ") : "",
      rivals.length && gone.length ? "without " + gone.map(recordWords).join(", ") : "",
    ]
      .filter(Boolean)
      .join("; ");
    // Records of the runner-up may not be on the map; then there is nothing to list.
    if (change) parts.push(text("h3", `Otherwise, with probability ${probability(objects.rival[r])}: ${change}`));
    if (change && objects.rival[r] > objects.p[r])
      parts.push(
        text("p", "By itself that is more probable; the answer is the most probable for all records together.", "hint"),
      );
    if (more.length) parts.push(memberTable(r, more, "rival"));
  }
  return parts;
}
function memberTable(r, rows, cls = "") {
  const t = document.createElement("table");
  t.className = "members";
  t.append(tableRow(...["source", data.live ? "track" : "track, line", "off", "age", "p"].map(words => text("th", words))));
  for (const m of rows) {
    const file = data.sensors[records.source[m]].file,
      track = textOf("r", "track_id", m),
      line = records.line[m] >= 0 ? `line ${records.line[m]}` : `row ${records.row[m]}`;
    // The rows of a live picture are those of one instant.
    const where = data.live && track ? "" : file ? `${file} ${line}` : line;
    const place = markPlace(m),
      off = place ? Math.hypot(place[0] - objects.x[r], place[1] - objects.y[r]) : NaN;
    const cells = [
      sourceCell(records.source[m]),
      text("td", [track, where].filter(Boolean).join(", ")),
      text("td", Number.isFinite(off) ? metres(off) : "–"),
      text("td", Number.isFinite(records.age[m]) ? duration(records.age[m]) : "–"),
      text("td", probability(records.p[m])),
    ];
    const tr = tableRow(...cells);
    tr.className = cls;
    tr.title = [
      Number.isFinite(records.alone[m])
        ? `probability that no other record is of this object: ${probability(records.alone[m])}`
        : "",
      Number.isFinite(records.bearing[m]) ? `bearing ${fix(records.bearing[m], 2)}° ± ${fix(records.sb[m], 2)}°` : "",
    ]
      .filter(Boolean)
      .join("\n");
    t.append(tr);
  }
  return t;
}

// ---- alarms, summary, legend ----
// Of alarms of one condition, a crowd, the first ones have rows of their own and the others are folded.
const CROWD_ROWS = 5;
const openCrowds = new Set();
function alarmRow(a) {
  const button = text("button", `${a.time === null ? "" : clock(a.time)[0] + "  "}${a.text}`);
  button.addEventListener("click", () => {
    if (a.instant !== null) show(a.instant);
    if (a.objects.length) pick(a.objects[0], true);
  });
  a.item = document.createElement("li");
  a.item.append(button, ...(a.beside ? a.beside() : []));
  return a.item;
}
function crowdRow(key, crowd) {
  const row = document.createElement("li"),
    fold = document.createElement("details"),
    list = document.createElement("ul");
  fold.open = openCrowds.has(key);
  fold.addEventListener("toggle", () => openCrowds[fold.open ? "add" : "delete"](key));
  list.append(...crowd.slice(CROWD_ROWS).map(alarmRow));
  fold.append(text("summary", `and ${crowd.length - CROWD_ROWS} more ${crowd[0].condition === "cpa" ? "approaches" : `of ${crowd[0].condition}`}`), list);
  row.append(fold, ...(crowd[0].besideAll ? crowd[0].besideAll(crowd) : []));
  return row;
}
function listAlarms() {
  const list = document.createElement("ul"),
    crowds = new Map();
  data.alarms.forEach((a, k) => {
    const key = a.condition ? `${a.active} ${a.fresh} ${a.condition}` : k;
    if (!crowds.has(key)) crowds.set(key, []);
    crowds.get(key).push(a);
  });
  for (const [key, crowd] of crowds) {
    list.append(...crowd.slice(0, CROWD_ROWS).map(alarmRow));
    if (crowd.length > CROWD_ROWS) list.append(crowdRow(key, crowd));
  }
  el("alarms").replaceChildren(data.alarms.length ? list : text("p", "No alarms.", "hint"));
}
function showAlarms() {
  // Of a live page, those of now, whatever instant is shown.
  const isCurrent = a => (data.live ? a.active : isActive(a, now.k));
  for (const a of data.alarms) a.item.className = isCurrent(a) ? "current" : "past";
  const current = data.alarms.filter(isCurrent).length;
  el("tab-alarms").replaceChildren(
    "Alarms",
    // The number that the button shows; those of other instants only where there is none now, in a picture from files.
    ...(current ? [text("span", ` ${current}`, "warn")] : data.live || !data.alarms.length ? [] : [` ${data.alarms.length}`]),
  );
  el("alarm-button").hidden = !current;
  el("alarm-button").textContent = `⚠ ${plural(current, "alarm")}`;
}
function showSummary() {
  const list = document.createElement("ul");
  list.append(...data.summary.map(line => text("li", line)));
  el("summary").replaceChildren(data.summary.length ? list : text("p", "No summary.", "hint"));
}
function showHelp() {
  const keys = [
    ["space", "play, pause"],
    ["← →", "one instant back, on"],
    ["Home End", "first, last instant"],
    ["+ − 0", "zoom in, out, show everything"],
    ["arrows", "move the chart when it has the focus"],
    ["N P", "next, previous object"],
    ["F", "centre on the selected object"],
    ["A", "alarms"],
    ["D", "day or night"],
    ["Esc", "deselect the object"],
  ];
  const t = document.createElement("table");
  t.append(
    ...keys.map(([key, words]) => {
      const cell = document.createElement("td");
      key.split(" ").forEach((k, n) => cell.append(n ? " " : "", text("kbd", k)));
      return tableRow(cell, text("td", words));
    }),
  );
  const notes = [
    "Circles are objects, crossed while no source shows them. Small dashed ones are tentative: it is not certain yet that they exist. They are last in the list. A dot: two or more sources show it. Lines ahead are where it will be if it keeps course and speed.",
    "An orange ring and “?”: which records belong to it is not certain; dashed lines lead to the records it would have otherwise. A red triangle: an alarm.",
    "Times are UTC, courses and bearings true, 1 nm = 1852 m. " +
      (data.origin
        ? "The coastline is accurate to about 1 km: not for navigation."
        : "Positions are metres in the user's plane."),
  ];
  if (!data.utc) notes[2] = notes[2].replace("Times are UTC, c", "Times are seconds as given, c");
  el("help").replaceChildren(t, ...notes.map(n => text("p", n, "hint")));
}
// Sources that an alarm is about.
function showFaultySources() {
  data.sensors.forEach((s, k) => {
    const words = data.alarms.filter(a => a.about?.endsWith(` ${s.name}`)).map(a => a.text),
      label = el("sources").querySelector(`[data-source="${k}"]`).closest("label");
    label.classList.toggle("faulty", words.length > 0);
    label.title = words.join("\n") || [s.name, s.kind, s.file].filter(Boolean).join(", ");
  });
}
function showLegend() {
  el("sources").replaceChildren(
    ...data.sensors.map((s, k) => {
      const label = document.createElement("label"),
        tick = document.createElement("input");
      tick.type = "checkbox";
      tick.checked = shown.source[k];
      tick.dataset.source = k;
      tick.addEventListener("change", () => {
        shown.source[k] = tick.checked;
        draw();
      });
      const count = text("span", "", "count");
      count.dataset.count = k;
      label.append(
        tick,
        sourceIcon(k),
        text("span", s.name, "name"),
        text("span", s.kind === s.name ? "" : s.kind, "kind"),
        count,
      );
      return label;
    }),
  );
  showFaultySources();
  const samples = [
    ["tentative", {}, STAGE.tentative],
    ["confirmed", {}, STAGE.confirmed],
    ["coasting", {}, STAGE.coasting],
    ["2+ sources", { several: true }, STAGE.confirmed],
    ["ambiguous", { ambiguous: true, several: true, r: 6 }, STAGE.confirmed],
    ["alarm", { alarmed: true, r: 4.5 }, STAGE.confirmed],
  ];
  el("marks-legend").replaceChildren(
    ...samples.map(([words, how, stage]) => {
      const s = document.createElement("span");
      s.append(
        icon(22, (c, m) => {
          if (words === "alarm") {
            c.translate(m, m + 2);
            c.scale(0.68, 0.68);
            c.translate(-m, -m);
          }
          drawSymbol(c, stage, m, m, { r: 7, ...how });
        }),
        words,
      );
      return s;
    }),
  );
}
function showCounts() {
  const counts = data.sensors.map(() => 0);
  for (const r of now.marks) counts[records.source[r]]++;
  for (const e of document.querySelectorAll("[data-count]")) {
    // The log of own ship has no records.
    const none = data.sensors[e.dataset.count].kind === "own ship";
    e.textContent = none || (data.live && now.k < last) ? "" : grouped(counts[e.dataset.count]);
  }
  const all = now.rows.filter(r => objects.stage[r] !== STAGE.ended),
    live = all.filter(r => !isTentative(r)),
    doubtful = live.filter(isAmbiguous).length,
    several = live.filter(isSeveral).length;
  el("counts").replaceChildren(
    text("b", plural(live.length, "object")),
    // What is doubtful first: on a narrow screen the end is cut.
    ...(doubtful ? [", ", text("span", `${grouped(doubtful)} ambiguous`, "warn")] : []),
    ...(data.sensors.length > 1 ? [`, ${grouped(several)} seen by two or more sources`] : []),
    ...(all.length > live.length ? [`, ${grouped(all.length - live.length)} tentative`] : []),
  );
}
