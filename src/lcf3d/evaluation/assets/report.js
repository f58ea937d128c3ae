"use strict";
// The page: sortable tables, charts, filters, and the frames. All text of the data is set as text, never as markup.

const DATA = JSON.parse(document.getElementById("data").textContent);
const COLOURS = ["#2563eb", "#d97706", "#059669", "#a855f7", "#dc2626", "#0891b2", "#65a30d", "#db2777", "#64748b", "#a16207"];
const FILLS = { right: "#1d4ed8", wrong: "#b91c1c", missed: "#b45309", found: "#15803d", matched: "#1d4ed8", recovered: "#0f766e",
  downweighted: "#7c3aed", kept: "#475569", predicted: "#be185d", unknown: "#64748b" };
const RANGES = [[0, 20], [20, 40], [40, null]];
const PAGE = 25;
const SHOWN_AT_FIRST = ["right", "wrong", "missed", "found"];
const byId = id => document.getElementById(id);
const main = DATA.runs.length - 1;

function element(name, properties = {}, ...children) {
  const node = document.createElement(name);
  for (const [key, value] of Object.entries(properties)) {
    if (key in node) node[key] = value; else node.setAttribute(key, value);
  }
  node.append(...children);
  return node;
}

// ---- sortable tables

function sortKey(text) {
  const number = parseFloat(text.replace(/[^\d.eE+-]/g, " ").trim());
  return Number.isNaN(number) ? text : number;
}

function compare(a, b) {
  if (typeof a === "number" && typeof b === "number") return a - b;
  if (typeof a === "number") return -1;
  return typeof b === "number" ? 1 : a.localeCompare(b, undefined, { numeric: true });
}

function sortable(table) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    if ("plain" in head.dataset) return;
    const button = element("button", { type: "button" });
    button.append(...head.childNodes);
    if (!button.textContent.trim()) button.setAttribute("aria-label", "sort by this column");
    head.append(button);
    button.addEventListener("click", () => {
      const rising = head.getAttribute("aria-sort") === "descending";
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", rising ? "ascending" : "descending");
      const rows = [...table.tBodies[0].rows].map(row => [sortKey(row.cells[column].textContent), row]);
      rows.sort((a, b) => (rising ? 1 : -1) * compare(a[0], b[0]));
      table.tBodies[0].append(...rows.map(row => row[1]));
    });
  });
}

// ---- theme

const THEMES = ["system", "light", "dark"];
let theme = 0;

function setTheme(next) {
  theme = next;
  if (theme) document.documentElement.dataset.theme = THEMES[theme];
  else delete document.documentElement.dataset.theme;
  byId("theme").textContent = `Theme: ${THEMES[theme]}`;
  drawCharts();
  showDetail();
}

function colour(name) { return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim(); }

// ---- charts

let plots = [];

// lines: {label, x, y, colour, dash, pick(i)}; a click or Enter picks the nearest point
function lineChart(title, xLabel, yLabel, xRange, yRange, lines, describe) {
  const plot = element("div", { className: "plot", tabIndex: 0 });
  plot.setAttribute("role", "application");
  plot.setAttribute("aria-label", `${title}: ${lines.map(l => l.label).join(", ")}. Left and right move along a line, up and down to another, Enter shows the frames.`);
  const figure = element("figure", {}, element("figcaption", { textContent: title }), plot, valuesOf(title, xLabel, yLabel, lines));
  byId("chart-grid").append(figure);
  const tables = lines.map(line => [line.x, line.y]);
  const joined = tables.length > 1 ? uPlot.join(tables) : tables[0] || [[], []];
  const axis = label => ({ label, stroke: colour("text"), grid: { stroke: colour("line"), width: 1 }, ticks: { stroke: colour("line") }, labelSize: 22, font: "12px system-ui", labelFont: "13px system-ui" });
  const chart = new uPlot({
    width: Math.max(plot.clientWidth, 200), height: 270,
    scales: { x: { time: false, range: xRange }, y: { range: yRange } },
    axes: [axis(xLabel), axis(yLabel)],
    cursor: { drag: { x: false, y: false }, points: { size: 8 } },
    legend: { live: false, markers: { width: 2, stroke: (_, i) => lines[i - 1]?.colour, dash: (_, i) => lines[i - 1]?.dash ? "dashed" : "solid" } },
    series: [{ label: xLabel }, ...lines.map(line => ({ label: line.label, stroke: line.colour, width: 2, dash: line.dash, spanGaps: true, points: { show: line.x.length < 30, size: 6 } }))],
  }, joined, plot);
  new ResizeObserver(() => { if (plot.clientWidth > 50) chart.setSize({ width: plot.clientWidth, height: 270 }); }).observe(plot);
  let at = [0, 0];
  const place = (line, i) => [chart.valToPos(lines[line].x[i], "x"), chart.valToPos(lines[line].y[i], "y")];
  chart.over.addEventListener("click", event => {
    const box = chart.over.getBoundingClientRect(), here = [event.clientX - box.left, event.clientY - box.top];
    let best = Infinity;
    lines.forEach((line, k) => line.x.forEach((_, i) => {
      const p = place(k, i), away = Math.hypot(p[0] - here[0], p[1] - here[1]);
      if (away < best) { best = away; at = [k, i]; }
    }));
    if (best < Infinity) lines[at[0]].pick(at[1]);
  });
  plot.addEventListener("keydown", event => {
    const moves = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] };
    if (!lines.length || !(event.key in moves) && event.key !== "Enter") return;
    event.preventDefault();
    if (event.key === "Enter") { lines[at[0]].pick(at[1]); return; }
    const [up, along] = moves[event.key];
    const line = (at[0] + up + lines.length) % lines.length;
    at = [line, Math.min(Math.max(at[1] + along, 0), lines[line].x.length - 1)];
    const [left, top] = place(...at);
    chart.setCursor({ left, top });
    byId("chart-word").textContent = describe(lines[line], at[1]);
  });
  plots.push(chart);
}

function valuesOf(title, xLabel, yLabel, lines) {
  const details = element("details", {}, element("summary", { textContent: "Values" }));
  details.addEventListener("toggle", () => {
    if (!details.open || details.children.length > 1) return;
    const body = element("tbody");
    for (const line of lines) {
      const step = Math.max(1, Math.ceil(line.x.length / 40));
      for (let i = 0; i < line.x.length; i += step) body.append(row("td", [line.label, line.x[i], line.y[i]]));
    }
    const table = element("table", {}, element("thead", {}, row("th", ["line", xLabel, yLabel])), body);
    details.append(element("div", { className: "scroll", tabIndex: 0, role: "region", "aria-label": `values of ${title}` }, table));
  });
  return details;
}

function row(kind, cells) { return element("tr", {}, ...cells.map(text => element(kind, { textContent: String(text ?? "-") }))); }

// rows: {label, parts: [{name, value, pick}]}; every part is a button
function barChart(title, rows, text = part => String(part.value)) {
  rows = rows.filter(r => r.parts.some(p => p.value > 0));
  if (!rows.length) return;
  const most = Math.max(...rows.map(r => r.parts.reduce((sum, p) => sum + p.value, 0)));
  const names = [...new Set(rows.flatMap(r => r.parts.map(p => p.name)))];
  const key = element("div", { className: "key" }, ...names.map(name => {
    const swatch = element("i");
    swatch.style.background = FILLS[name] || COLOURS[0];
    return element("span", {}, swatch, name);
  }));
  const bars = rows.map(r => {
    const stack = element("span", { className: "stack" });
    stack.style.width = `${100 * r.parts.reduce((sum, p) => sum + p.value, 0) / most}%`;
    for (const part of r.parts.filter(p => p.value > 0)) {
      const button = element("button", { type: "button", textContent: text(part), title: `${r.label}, ${part.name}: ${text(part)}` });
      button.setAttribute("aria-label", `${r.label}, ${part.name}: ${text(part)}. Show the frames`);
      button.style.flex = `${part.value} 1 0`;
      button.style.background = FILLS[part.name] || COLOURS[0];
      button.addEventListener("click", part.pick);
      stack.append(button);
    }
    return element("div", { className: "bar" }, element("span", { textContent: r.label }), stack);
  });
  byId("chart-grid").append(element("figure", {}, element("figcaption", { textContent: title }), key, ...bars));
}

function drawCharts() {
  for (const plot of plots) plot.destroy();
  plots = [];
  byId("chart-grid").replaceChildren();
  const each = DATA.runs.flatMap((run, r) => run.classes.map(part => {
    const number = DATA.classes.indexOf(part.name);
    return { run: r, part, number, colour: COLOURS[number % COLOURS.length], dash: r < main ? [6, 4] : undefined,
      label: DATA.runs.length > 1 ? `${part.name}, ${run.name}` : part.name };
  }));
  const line = (one, x, y, pick) => ({ ...one, x, y, pick });
  const seen = one => ({ run: one.run, cls: one.number });
  const say = (l, i) => `${l.label}: ${l.x[i]}, ${l.y[i]}`;
  const kinds = [...new Set(each.map(one => one.part.threshold))].join(" and ") || "threshold";
  const reach = Math.max(1, ...each.flatMap(one => one.part.ap[0]));
  lineChart(`AP over the ${kinds}`, kinds, "AP, %", [0, reach], [0, 100],
    each.map(one => line(one, ...one.part.ap, () => choose({ ...seen(one), outcomes: ["wrong", "missed"] }))), say);
  lineChart("Precision over recall", "recall", "precision", [0, 1], [0, 1.02],
    each.map(one => line(one, one.part.curve[0], one.part.curve[1], i =>
      choose({ ...seen(one), outcomes: ["wrong"], low: one.part.curve[2][i] }))),
    (l, i) => `${l.label}: recall ${l.x[i]}, precision ${l.y[i]}, score ${l.part.curve[2][i]}`);
  const bins = each.filter(one => one.part.reliability.length);
  if (bins.length) {
    const diagonal = { label: "calibrated", x: [0, 1], y: [0, 1], colour: colour("soft"), dash: [2, 4], pick: () => {} };
    lineChart("Reliability: share of right detections by score", "score", "share right", [0, 1], [0, 1.02], [...bins.map(one => {
      const rows = one.part.reliability;
      return line({ ...one, label: `${one.label}, error ${one.part.calibration_error.toFixed(3)}` }, rows.map(b => b[0]), rows.map(b => b[1]), i => {
        const low = Math.min(.9, Math.floor(rows[i][0] * 10) / 10);
        choose({ ...seen(one), outcomes: ["right", "wrong"], low, high: low + .1 });
      });
    }), diagonal], say);
  }
  barChart("At the best F1", each.map(one => ({ label: one.label, parts: [["right", "true_positives"], ["wrong", "false_positives"], ["missed", "misses"]].map(([name, key]) => ({
    name, value: one.part.best_f1[key] || 0, pick: () => choose({ ...seen(one), outcomes: [name] }) })) })));
  const ranges = each.flatMap(one => one.part.distance.map(([near, far, ap, objects]) => ({
    label: `${one.label}, ${rangeText([near, far])}`, parts: [{ name: "AP", value: ap || 0, objects,
      pick: () => choose({ ...seen(one), outcomes: ["wrong", "missed"], range: RANGES.findIndex(r => r[0] === near) }) }] })));
  barChart("AP by distance, %", ranges, part => `${part.value.toFixed(1)} (${part.objects})`);
  barChart("What the fusion did, at the best F1", each.filter(one => one.part.fusion).flatMap(one =>
    [["right", "true_positives"], ["wrong", "false_positives"]].map(([outcome, key]) => ({ label: `${one.label}, ${outcome}`,
      parts: Object.entries(one.part.fusion[key]).map(([name, value]) => ({ name, value,
        pick: () => choose({ ...seen(one), outcomes: [outcome], origin: DATA.origins.indexOf(name) }) })) }))));
}

function rangeText([near, far]) { return far === null ? `${near} m and more` : `${near} to ${far} m`; }

// ---- filters

const NOTHING = { run: main, cls: -1, range: -1, camera: -1, origin: -1, low: null, high: null, text: "", outcomes: SHOWN_AT_FIRST };
let state = { ...NOTHING }, page = 0, selected = null, order = ["errors", -1];

function choose(change) {
  state = { ...NOTHING, ...change };
  page = 0;
  buildFilters();
  showFrames(true);
  byId("frames").scrollIntoView({ behavior: "auto", block: "start" });
}

function picker(label, key, options) {
  const select = element("select", {}, ...options.map(([value, text]) => element("option", { value, textContent: text })));
  select.value = state[key];
  select.addEventListener("change", () => { state = { ...state, [key]: Number(select.value) }; page = 0; showFrames(true); });
  return element("label", {}, `${label} `, select);
}

function buildFilters() {
  const every = [-1, "all"], controls = [];
  const numbered = names => [every, ...names.map((name, i) => [i, name])];
  if (DATA.runs.length > 1) controls.push(picker("results", "run", DATA.runs.map((run, i) => [i, run.name])));
  controls.push(picker("class", "cls", numbered(DATA.classes)), picker("distance", "range", numbered(RANGES.map(rangeText))));
  if (DATA.cameras.length > 1) controls.push(picker("camera", "camera", numbered(DATA.cameras)));
  if (DATA.runs.some(run => run.classes.some(part => part.fusion))) controls.push(picker("fusion", "origin", numbered(DATA.origins)));
  const score = element("input", { type: "number", step: "any", value: state.low ?? "", size: 6 });
  score.addEventListener("change", () => { state = { ...state, low: score.value === "" ? null : Number(score.value), high: null }; page = 0; showFrames(true); });
  const search = element("input", { type: "search", value: state.text });
  search.addEventListener("input", () => { state = { ...state, text: search.value }; page = 0; showFrames(false); });
  const boxes = DATA.outcomes.map(name => {
    const box = element("input", { type: "checkbox", checked: state.outcomes.includes(name), value: name });
    box.addEventListener("change", () => {
      state = { ...state, outcomes: DATA.outcomes.filter(o => o === name ? box.checked : state.outcomes.includes(o)) };
      page = 0;
      showFrames(true);
    });
    const swatch = element("i");
    swatch.style.border = `2px ${isObject(name) ? "dashed" : "solid"} var(--${name})`;
    return element("label", { className: "key" }, element("span", {}, box, " ", swatch, OUTCOME_TEXT[name]));
  });
  const outcomes = element("fieldset", {}, element("legend", { textContent: "outcome" }), ...boxes);
  const reset = element("button", { type: "button", textContent: "Reset" });
  reset.addEventListener("click", () => choose({}));
  byId("filters").replaceChildren(...controls, element("label", {}, "score from ", score), element("label", {}, "frame ", search), outcomes, reset);
}

const OUTCOME_TEXT = { right: "right", wrong: "wrong", missed: "object missed", found: "object found", ignored: "does not count", dropped: "dropped by the fusion" };

function away(box) { return box.b ? Math.hypot(box.b[0], box.b[1]) : null; }

function passes(box) {
  if (!state.outcomes.includes(DATA.outcomes[box.o])) return false;
  if (state.cls >= 0 && box.c !== state.cls) return false;
  if (state.origin >= 0 && box.g !== state.origin) return false;
  if (state.camera >= 0 && !(box.v || []).includes(state.camera)) return false;
  if (state.low !== null && !(box.s >= state.low)) return false;
  if (state.high !== null && !(box.s <= state.high)) return false;
  if (state.range < 0) return true;
  const [near, far] = RANGES[state.range], d = away(box);
  return d !== null && d >= near && (far === null || d < far);
}

function isFiltered() {
  return ["cls", "range", "camera", "origin"].some(key => state[key] >= 0) || state.low !== null || state.outcomes.join() !== SHOWN_AT_FIRST.join();
}

function chosenFrames() {
  const rows = [], filtered = isFiltered();
  for (const frame of DATA.frames) {
    if (state.text && !frame.id.toLowerCase().includes(state.text.toLowerCase())) continue;
    const own = frame.runs[state.run], boxes = own.boxes.filter(passes).length;
    if (filtered && !boxes) continue;
    const other = frame.runs.length > 1 ? frame.runs[1 - state.run] : null;
    rows.push({ frame, id: frame.id, wrong: own.wrong, missed: own.missed, errors: own.wrong + own.missed, boxes,
      gain: other ? own.wrong + own.missed - other.wrong - other.missed : 0 });
  }
  const [key, sign] = order;
  return rows.sort((a, b) => sign * compare(a[key], b[key]));
}

// ---- frames

const COLUMNS = [["id", "frame"], ["errors", "errors"], ["wrong", "wrong"], ["missed", "missed"], ["boxes", "boxes"],
  ...(DATA.runs.length > 1 ? [["gain", "± other"]] : [])];

function buildHead() {
  const cells = COLUMNS.map(([key, text]) => {
    const button = element("button", { type: "button", textContent: text });
    const head = element("th", { scope: "col" }, button);
    button.addEventListener("click", () => {
      order = [key, order[0] === key ? -order[1] : key === "id" ? 1 : -1];
      for (const other of head.parentNode.cells) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", order[1] > 0 ? "ascending" : "descending");
      page = 0;
      showFrames(false);
    });
    if (key === "errors") head.setAttribute("aria-sort", "descending");
    return head;
  });
  byId("frame-table").tHead.replaceChildren(element("tr", {}, ...cells));
}

function showFrames(pickFirst) {
  const rows = chosenFrames(), pages = Math.max(1, Math.ceil(rows.length / PAGE));
  page = Math.min(page, pages - 1);
  byId("page").textContent = `${page + 1} of ${pages}`;
  byId("before").disabled = page === 0;
  byId("next").disabled = page >= pages - 1;
  const total = rows.reduce((sum, r) => sum + r.boxes, 0);
  byId("chosen").textContent = `${rows.length} of ${DATA.frames.length} frames, ${total} boxes: ${sentence()}`;
  if (pickFirst && rows.length) selected = rows[0].frame;
  if (!rows.length) selected = null;
  byId("frame-table").tBodies[0].replaceChildren(...rows.slice(page * PAGE, (page + 1) * PAGE).map(r => {
    const button = element("button", { type: "button", textContent: r.id });
    button.addEventListener("click", () => { selected = r.frame; showFrames(false); byId("detail").scrollIntoView({ block: "nearest" }); });
    const mark = frameHasPicture(r.frame) ? " ▣" : "";
    const line = element("tr", {}, element("td", {}, button, mark), ...COLUMNS.slice(1).map(([key]) => element("td", { textContent: r[key] })));
    line.setAttribute("aria-selected", r.frame === selected);
    return line;
  }));
  showDetail();
}

function sentence() {
  const parts = [state.cls >= 0 ? DATA.classes[state.cls] : "all classes", state.outcomes.map(o => OUTCOME_TEXT[o]).join(", ") || "no outcome"];
  if (state.range >= 0) parts.push(rangeText(RANGES[state.range]));
  if (state.camera >= 0) parts.push(`in view of ${DATA.cameras[state.camera]}`);
  if (state.origin >= 0) parts.push(DATA.origins[state.origin]);
  if (state.low !== null) parts.push(`score from ${Number(state.low.toPrecision(4))}${state.high === null ? "" : ` to ${Number(state.high.toPrecision(4))}`}`);
  if (DATA.runs.length > 1) parts.push(DATA.runs[state.run].name);
  return parts.join("; ");
}

function frameHasPicture(frame) { return DATA.pictures_from || Object.hasOwn(DATA.pictures, frame.id); }

async function pictureOf(frame) {
  if (Object.hasOwn(DATA.pictures, frame.id)) return DATA.pictures[frame.id];
  if (!DATA.pictures_from) return null;
  const answer = await fetch(`${DATA.pictures_from}?frame=${encodeURIComponent(frame.id)}`);
  return answer.ok ? answer.json() : null;
}

function described(box) {
  const outcome = DATA.outcomes[box.o];
  const name = `${DATA.classes[box.c]}${box.s === undefined ? "" : ` ${box.s.toFixed(2)}`}`;
  const text = `${name}: ${OUTCOME_TEXT[outcome]}${box.b ? `, ${away(box).toFixed(1)} m away` : ""}${box.w ? `. ${box.w}` : ""}`;
  return { ...box, outcome, text };
}

async function showDetail() {
  const frame = selected, detail = byId("detail");
  if (!frame) { detail.replaceChildren(element("p", { className: "note", textContent: "No frame passes the filters." })); return; }
  const run = frame.runs[state.run];
  const boxes = run.boxes.map(box => passes(box) ? described(box) : null);
  const shown = boxes.map(box => box || {});
  const why = element("p", { className: "why", textContent: "Rest on a box to see what it is and why it is there." });
  why.setAttribute("aria-live", "polite");
  const mark = (index, lit) => { for (const node of detail.querySelectorAll(`[data-box="${index}"]`)) node.classList.toggle("lit", lit); };
  let last = null;
  const hooks = {
    enter(index) { if (last !== null) mark(last, false); last = index; mark(index, true); why.textContent = boxes[index].text; },
    leave(index) { mark(index, false); },
  };
  const counts = frame.runs.map((r, i) => `${DATA.runs.length > 1 ? `${DATA.runs[i].name}: ` : ""}${r.wrong} wrong, ${r.missed} missed`).join("; ");
  const views = element("div", { className: "views" });
  detail.replaceChildren(element("h3", { textContent: `Frame ${frame.id}` }), element("p", { className: "note", textContent: counts }), why, views, boxTable(boxes, hooks));
  const picture = await pictureOf(frame);
  if (selected !== frame || !views.isConnected) return;
  for (const image of picture?.images || []) {
    if (state.camera >= 0 && DATA.cameras[state.camera] !== image.camera) continue;
    const rectangles = image.boxes[state.run] || [];
    const view = element("figure", { className: (picture.images.length < 3) ? "wide" : "" }, viewInImage(image, rectangles, boxes, hooks), element("figcaption", { textContent: image.camera }));
    views.append(view);
  }
  if (run.boxes.some(box => box.b)) views.append(element("figure", {}, viewFromAbove(shown, hooks), element("figcaption", { textContent: "From above" })));
  if (picture?.scan) {
    const space = new ViewInSpace(picture.scan, boxes);
    views.append(element("figure", {}, space.canvas, element("figcaption", { textContent: "Scan, thinned: drag or arrow keys turn it" })));
    space.draw();
  }
}

function boxTable(boxes, hooks) {
  const body = element("tbody");
  boxes.forEach((box, index) => {
    if (!box) return;
    const line = row("td", [DATA.classes[box.c], OUTCOME_TEXT[box.outcome], box.s === undefined ? "" : box.s.toFixed(3), box.b ? away(box).toFixed(1) : ""]);
    line.append(element("td", { className: "why-cell", textContent: box.w || "" }));
    line.dataset.box = index;
    line.addEventListener("pointerenter", () => hooks.enter(index));
    line.addEventListener("pointerleave", () => hooks.leave(index));
    body.append(line);
  });
  const table = element("table", { id: "box-table" }, element("thead", {}, row("th", ["class", "outcome", "score", "away, m", "why"])), body);
  sortable(table);
  return element("div", { className: "scroll", tabIndex: 0, role: "region", "aria-label": "boxes of the frame" }, table);
}

// ---- start

for (const table of document.querySelectorAll("table.sortable")) sortable(table);
byId("theme").hidden = false;
byId("theme").addEventListener("click", () => setTheme((theme + 1) % THEMES.length));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { drawCharts(); showDetail(); });
byId("before").addEventListener("click", () => { page -= 1; showFrames(false); });
byId("next").addEventListener("click", () => { page += 1; showFrames(false); });
byId("filters").addEventListener("submit", event => event.preventDefault());
buildHead();
drawCharts();
buildFilters();
showFrames(true);
