"use strict";
// The page's script: charts as SVG and the frame browser, from the JSON that the page carries. Nothing is loaded.
(() => {
const $ = id => document.getElementById(id);
const read = id => { const node = $(id); return node ? JSON.parse(node.textContent) : null; };
const D = read("data");
const METHODS = D.methods.map((name, k) => ({ name, k, style: `s${k % 8} d${Math.floor(k / 8) % 5}` }));
const TRUTH = { name: "truth", k: -1, style: "truth" };
const FEW = 6;  // methods that are shown at first
const NUMBERS = ["nll", "iou_free", "iou_occupied", "brier", "false_free", "missed_occupied"].filter(m => D.perFrame[m]);  // beside the pictures

// ---------- small helpers

function node(tag, attributes = {}, ...children) {
  const svg = ["svg", "path", "line", "rect", "text", "g", "circle", "title"].includes(tag);
  const made = svg ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) if (value !== null && value !== false) made.setAttribute(key, value);
  made.append(...children);  // texts become text nodes: names cannot be markup
  return made;
}
const swatch = method => node("i", { class: `swatch ${method.style}`, "aria-hidden": "true" });
const option = (value, text) => node("option", { value }, text);
const title = metric => D.metrics[metric] ? D.metrics[metric].title : metric.replaceAll("_", " ");
const sign = metric => ({ lower: " ↓", higher: " ↑" })[D.metrics[metric]?.better] ?? "";
function format(value) {
  if (value === null || value === undefined) return "–";
  const size = Math.abs(value);
  if (size && (size < 1e-3 || size >= 1e5)) return value.toExponential(1);
  return value.toFixed(size < 10 ? 3 : size < 1000 ? 1 : 0);
}
const formatP = p => p === null || p === undefined ? "–" : p < 0.001 ? "< 0.001" : p.toFixed(3);
const extent = lists => {
  let low = Infinity, high = -Infinity;
  for (const list of lists) for (const v of list) if (v !== null) { if (v < low) low = v; if (v > high) high = v; }
  return low <= high ? [low, high] : null;
};

// ---------- which methods are shown

const shown = new Set(firstShown());
function firstShown() {  // all, or where they are many: the first, which is the baseline, and the best of each metric
  if (METHODS.length <= 8) return METHODS.keys();
  const chosen = new Set([0]);
  for (const metric of D.headline) if (chosen.size < FEW && D.metrics[metric].better) {
    const best = METHODS.map(m => [mean(D.perFrame[metric][m.k]), m.k]).filter(([v]) => v !== null);
    best.sort((a, b) => a[0] - b[0]);
    if (best.length) chosen.add(best.at(D.metrics[metric].better === "lower" ? 0 : -1)[1]);
  }
  for (const m of METHODS) if (chosen.size < FEW) chosen.add(m.k);
  return chosen;
}
function mean(values) {
  const kept = values.filter(v => v !== null);
  return kept.length ? kept.reduce((a, b) => a + b, 0) / kept.length : null;
}
const shownMethods = () => METHODS.filter(m => shown.has(m.k));

function chooser() {
  for (const m of METHODS) {
    const box = node("input", { type: "checkbox", "data-k": m.k });
    box.checked = shown.has(m.k);
    box.addEventListener("change", () => { box.checked ? shown.add(m.k) : shown.delete(m.k); all(); });
    $("chips").append(node("label", { title: m.name }, box, swatch(m), node("span", {}, m.name)));
  }
  if (METHODS.length > 3) for (const [text, on] of [["all", true], ["none", false]]) {
    const button = node("button", { type: "button" }, text);
    button.addEventListener("click", () => {
      for (const box of $("chips").querySelectorAll("input")) box.checked = on;
      for (const m of METHODS) on ? shown.add(m.k) : shown.delete(m.k);
      all();
    });
    $("chips").append(button);
  }
}

// ---------- charts

// One chart of lines or dots. Series: {m, x, y, cls, dots, note(i)}; x and y are equally long lists, null is a gap.
function chart(place, { x, y, series, guides = [], height = 240, label, pick = null, read = null, bars = [] }) {
  const width = Math.max(280, place.clientWidth || 600), left = 62, right = 10, top = 10, bottom = 40;
  const scale = (axis, from, to) => {
    const f = axis.log ? v => Math.log10(Math.max(v, axis.min)) : v => v;
    const low = f(axis.min), span = (f(axis.max) - low) || 1;
    const way = v => from + (f(v) - low) / span * (to - from);
    way.back = p => low + (p - from) / (to - from) * span;
    return way;
  };
  const X = scale(x, left, width - right), Y = scale(y, height - bottom, top);
  const svg = node("svg", { class: `plot${pick ? " pick" : ""}`, viewBox: `0 0 ${width} ${height}`, height, role: "img", "aria-label": label });
  for (const [axis, at, horizontal] of [[x, X, true], [y, Y, false]]) {
    for (const tick of axis.ticks ?? ticks(axis, horizontal ? (width - left) / 90 : height / 55)) {
      const p = at(tick.at ?? tick), text = tick.text ?? tickText(tick, axis);
      svg.append(horizontal ? node("line", { class: "grid", x1: p, x2: p, y1: top, y2: height - bottom })
        : node("line", { class: "grid", x1: left, x2: width - right, y1: p, y2: p }));
      svg.append(horizontal ? node("text", { x: p, y: height - bottom + 15, "text-anchor": "middle" }, text)
        : node("text", { x: left - 6, y: p + 4, "text-anchor": "end" }, text));
    }
  }
  svg.append(node("rect", { class: "frame", x: left, y: top, width: width - left - right, height: height - top - bottom }),
    node("text", { x: (left + width - right) / 2, y: height - 6, "text-anchor": "middle" }, x.label),
    node("text", { x: 12, y: (top + height - bottom) / 2, "text-anchor": "middle", transform: `rotate(-90 12 ${(top + height - bottom) / 2})` }, y.label));
  for (const guide of guides) svg.append(node("path", { class: `guide ${guide.cls ?? ""}`, d: path(guide.x, guide.y, X, Y) }));
  for (const border of x.borders ?? []) {
    svg.append(node("line", { class: "guide", x1: X(border.at), x2: X(border.at), y1: top, y2: height - bottom }));
    if (border.text) svg.append(node("text", { x: X(border.at) + 4, y: top + 12 }, border.text));
  }
  for (const bar of bars) svg.append(node("line", { class: `line ${bar.m.style.split(" ")[0]}`, style: "stroke-width:7;opacity:.35", x1: X(bar.x), x2: X(bar.x), y1: Y(bar.low), y2: Y(bar.high) }));
  for (const s of series) {
    const g = node("g", { class: s.m.style.split(" ")[0] });
    if (s.line !== false) g.append(node("path", { class: `line ${s.m.style} ${s.cls ?? ""}`, d: path(s.x, s.y, X, Y, s.joined, s.steps) }));
    if (s.dots) g.append(node("path", { class: "dots", style: s.dots > 1 ? `stroke-width:${s.dots}` : null, d: s.x.map((v, i) => v === null || s.y[i] === null ? "" : `M${X(v).toFixed(1)} ${Y(s.y[i]).toFixed(1)}h.01`).join("") }));
    svg.append(g);
  }
  const cursor = node("line", { class: "cursor", y1: top, y2: height - bottom, visibility: "hidden" });
  svg.append(cursor);
  const spot = event => {
    const box = svg.getBoundingClientRect();
    return [(event.clientX - box.left) * width / box.width, (event.clientY - box.top) * height / box.height];
  };
  const nearest = px => Math.min(Math.max(Math.round(X.back(px)), Math.ceil(x.min)), Math.floor(x.max));
  svg.addEventListener("pointermove", event => {
    const [px, py] = spot(event);
    if (read) {
      const i = nearest(px);
      cursor.setAttribute("x1", X(i)); cursor.setAttribute("x2", X(i)); cursor.setAttribute("visibility", "visible");
      tip(event, read(i));
      return;
    }
    let best = null, near = 40 ** 2;
    for (const s of series) s.x.forEach((v, i) => {
      if (v === null || s.y[i] === null) return;
      const d = (X(v) - px) ** 2 + (Y(s.y[i]) - py) ** 2;
      if (d < near) { near = d; best = [s, i]; }
    });
    if (!best) return tip(null);
    const [s, i] = best;
    tip(event, [node("b", {}, s.label ?? s.m.name), `${x.label}: ${format(s.x[i])}; ${y.label}: ${format(s.y[i])}`, s.note ? `; ${s.note(i)}` : ""]);
  });
  svg.addEventListener("pointerleave", () => { tip(null); cursor.setAttribute("visibility", "hidden"); });
  if (pick) svg.addEventListener("click", event => pick(nearest(spot(event)[0])));
  svg.here = i => {
    svg.querySelector(".here")?.remove();
    if (i >= 0) svg.append(node("line", { class: "here", x1: X(i), x2: X(i), y1: top, y2: height - bottom }));
  };
  place.replaceChildren(svg);
  return svg;
}

function path(xs, ys, X, Y, joined = null, steps = "") {  // steps: "HV" keeps a value up to the next point, "VH" has it from the last one
  let d = "", pen = false;
  xs.forEach((v, i) => {
    if (v === null || ys[i] === null) { pen = false; return; }
    const px = X(v).toFixed(1), py = Y(ys[i]).toFixed(1);
    d += !pen || joined && !joined[i] ? `M${px} ${py}` : steps === "HV" ? `H${px}V${py}` : steps === "VH" ? `V${py}H${px}` : `L${px} ${py}`;
    pen = true;
  });
  return d;
}

function ticks(axis, most) {
  if (axis.log) {
    const found = [];
    for (let e = Math.ceil(Math.log10(axis.min) - 1e-9); 10 ** e <= axis.max * 1.001; e++) found.push(10 ** e);
    return found;
  }
  const raw = (axis.max - axis.min) / Math.max(2, most), power = 10 ** Math.floor(Math.log10(raw || 1));
  let step = power * [1, 2, 5, 10].find(f => f * power >= raw);
  if (axis.whole) step = Math.max(1, Math.round(step));
  const found = [];
  for (let v = Math.ceil(axis.min / step - 1e-9) * step; v <= axis.max + step * 1e-6; v += step) found.push(Number(v.toPrecision(10)));
  return found;
}
const tickText = (v, axis) => axis.log && axis.percent ? `${Number((100 * v).toPrecision(3))} %` : String(v);

function tip(event, content = []) {
  const box = $("tip");
  box.hidden = !event;
  if (!event) return;
  box.replaceChildren(...[content].flat());
  const { width, height } = box.getBoundingClientRect();
  box.style.left = `${Math.max(4, Math.min(event.clientX + 16, innerWidth - width - 8))}px`;
  box.style.top = `${Math.max(4, Math.min(event.clientY + 16, innerHeight - height - 8))}px`;
}

// ---------- figures over frames

let onFrames = [];  // their SVGs
let axis = [];  // place on the x axis -> frame
let figureMetric = "";

function frameFigures() {
  axis = $("order").value === "browser" ? ranking() : D.frames.map((_, i) => i);
  const n = axis.length, inOrder = $("order").value === "data";
  const joined = axis.map((f, i) => inOrder && i > 0 && D.frames[f][2]);
  const borders = [];
  if (inOrder) axis.forEach((f, i) => {
    if (i === 0 ? D.frames[f][1] && D.frames.at(-1)[1] !== D.frames[f][1] : D.frames[f][1] !== D.frames[axis[i - 1]][1]) borders.push({ at: i - 0.5, text: D.frames[f][1] });
  });
  const letters = Math.floor((innerWidth - 120) / Math.max(1, borders.length) / 8);  // letters per sequence, about
  for (const border of borders) if (border.text.length > letters) border.text = letters < 4 ? "" : `…${border.text.slice(1 - letters)}`;
  const x = { label: inOrder ? "frame, in the order of the data" : `frame, ${orderText()}`, min: -0.5, max: n - 0.5, whole: true, borders };
  const size = n > 400 ? 2.5 : n > 120 ? 3.5 : n > 40 ? 5 : 7;
  const one = (place, metric, label, extra, height) => {
    const series = shownMethods().map(m => ({ m, x: axis.map((_, i) => i), y: axis.map(f => D.perFrame[metric][m.k][f]), joined, dots: size, cls: "thin" }));
    if (extra) series.unshift({ m: TRUTH, x: axis.flatMap((_, i) => [i - 0.4, i + 0.4]), y: axis.flatMap(f => [extra[f], extra[f]]), joined: axis.flatMap((_, i) => [joined[i], true]), at: i => extra[axis[i]] });
    const range = extent(series.map(s => s.y));
    if (!range) return noValues(place, metric);
    const pad = (range[1] - range[0] || 1) * 0.06;
    const y = { label, min: range[0] >= 0 && range[0] < range[1] / 2 ? 0 : range[0] - pad, max: range[1] + pad };
    const read = i => {
      const f = axis[i];
      if (f === undefined) return [];
      const rows = series.map(s => [s.m, s.at ? s.at(i) : s.y[i]]).filter(([, v]) => v !== null).sort((a, b) => a[1] - b[1]);
      return [node("b", {}, D.frames[f][0]), node("table", {}, ...rows.slice(0, 16).map(([m, v]) => node("tr", {}, node("td", {}, swatch(m), m.name), node("td", {}, format(v)))))];
    };
    onFrames.push(chart(place, { x, y, series, height, label: `${label} of every shown method in every frame`, pick: i => { if (axis[i] !== undefined) { go(axis[i]); $("frames").scrollIntoView(); $("stage").focus({ preventScroll: true }); } }, read }));
  };
  onFrames = [];
  $("figure-metric-description").textContent = `${title(figureMetric)}${sign(figureMetric)}: ${D.metrics[figureMetric].description}`;
  one($("chart-metric"), figureMetric, title(figureMetric), null, 300);
  const known = D.frames.map((_, f) => D.truth.unknown[f] + D.truth.free[f] + D.truth.occupied[f]);  // 1 - ignored, which is rounded, would be too rough
  for (const state of ["unknown", "free", "occupied"]) if (D.perFrame[`mean_${state}`]) {
    const truth = D.truth[state]?.map((v, f) => v === null || !(known[f] > 0) ? null : v / known[f]);
    one($(`chart-${state}`), `mean_${state}`, `mean ${state}`, truth, 190);
  }
  mark();
}

function noValues(place, metric) {
  place.replaceChildren(node("p", { class: "reason" }, `${title(metric)} has no value in any frame for the shown methods.`));
}

const mark = () => { for (const svg of onFrames) svg.here(axis.indexOf(frame)); };

function figureControls() {
  for (const metric of Object.keys(D.perFrame)) $("figure-metric").append(option(metric, title(metric) + sign(metric)));
  const quick = ["nll", "kl_e10", "kl_e1", "legacy_kl"].filter(m => D.perFrame[m]);
  figureMetric = quick[0] ?? D.headline[0];
  const set = metric => {
    figureMetric = $("figure-metric").value = metric;
    for (const button of $("figure-switch").children) button.setAttribute("aria-pressed", button.dataset.metric === metric);
    frameFigures();
  };
  for (const metric of quick) {
    const button = node("button", { type: "button", "data-metric": metric }, { nll: "NLL", kl_e10: "KL, E = 10", kl_e1: "E = 1", legacy_kl: "as released" }[metric]);
    button.addEventListener("click", () => set(metric));
    $("figure-switch").append(button);
  }
  $("figure-metric").addEventListener("change", event => set(event.target.value));
  $("order").addEventListener("change", frameFigures);
  $("figure-metric").value = figureMetric;
  for (const button of $("figure-switch").children) button.setAttribute("aria-pressed", button.dataset.metric === figureMetric);
}

// ---------- curves

const UNIT = { min: 0, max: 1 };
const lines = (get, more = () => ({})) => shownMethods().flatMap(m => {
  const found = get(D.curves[m.k]);
  return found && found.x && found.y ? [{ m, ...found, ...more(m) }] : [];
});

function tile(place, heading, text, spec) {
  const box = node("div", { class: "chart" });
  place.append(node("div", {}, node("h3", {}, heading), node("p", {}, text), box));
  if (spec.series.some(s => s.x.some((v, i) => v !== null && s.y[i] !== null))) chart(box, { label: `${heading}. ${text}`, ...spec });
  else box.append(node("p", { class: "reason" }, "No values for the shown methods."));
}

function curves() {
  const place = $("curve-tiles");
  place.replaceChildren();
  const diagonal = [{ x: [0, 1], y: [0, 1] }];
  for (const [which, text] of [["all", "P(occupied) = occupied + unknown / 2 on known cells: the predicted against the observed share."], ["relative", "occupied / (free + occupied) on known cells: the same without the mass of unknown."]]) {
    const series = lines(c => { const r = c.reliability?.[which]; return r && { x: r.predicted, y: r.observed, dots: 5, note: i => `${r.cells[i]} cells` }; });
    tile(place, `Reliability, ${which}`, text, { x: { ...UNIT, label: "predicted P(occupied)" }, y: { ...UNIT, label: "share occupied" }, series, guides: diagonal });
  }
  const risks = lines(c => c.risk_coverage && { x: c.risk_coverage.coverage, y: c.risk_coverage.risk });
  const oracles = lines(c => c.risk_coverage && { x: c.risk_coverage.coverage, y: c.risk_coverage.oracle }, m => ({ cls: "oracle", label: `${m.name}, oracle` }));
  const worst = extent(risks.map(s => s.y));
  tile(place, "Risk and coverage", "Error among the known cells that are least unknown; dotted: the oracle, which leaves out the wrong cells first.", { x: { ...UNIT, label: "coverage" }, y: { min: 0, max: (worst?.[1] || 1) * 1.08, label: "risk" }, series: [...risks, ...oracles] });
  tile(place, "Free space and its danger", "Recall of free cells against the share of occupied cells that are predicted free, for falling thresholds on Bel(free).", {
    x: { min: 1e-4, max: 1, log: true, percent: true, label: "false-free rate" }, y: { ...UNIT, label: "free recall" },
    guides: [{ x: [1e-3, 1e-3], y: [0, 1] }, { x: [1e-2, 1e-2], y: [0, 1] }],
    series: lines(c => c.free_space && { x: c.free_space.false_free, y: c.free_space.recall, steps: "HV", note: i => `threshold ${format(c.free_space.threshold[i])}` }) });
  for (const tolerance of ["0", "1"]) tile(place, `Precision and recall${tolerance === "0" ? "" : ", ± one cell"}`, tolerance === "0" ? "Of occupied cells, one by one, for thresholds on P(occupied)." : "The same where a neighbouring cell counts as right, too.", {
    x: { ...UNIT, label: "recall" }, y: { ...UNIT, label: "precision" },
    series: lines(c => { const p = c.precision_recall?.[tolerance]; return p && { x: p.recall, y: p.precision, steps: "VH", note: i => `threshold ${format(p.threshold[i])}` }; }) });
  byRange(place);
  const spans = $("interval-tiles");
  spans.replaceChildren();
  for (const m of shownMethods()) {
    const c = D.curves[m.k].intervals;
    if (!c) continue;
    const seen = c.observed.map((v, i) => v === null || !c.cells[i] ? null : v);
    tile(spans, m.name, "", { x: { ...UNIT, label: "mean Bel(occupied)" }, y: { ...UNIT, label: "share occupied" }, height: 200, guides: diagonal,
      series: [{ m, x: c.belief, y: seen, line: false, dots: 7, note: i => `belief ${format(c.belief[i])}, plausibility ${format(c.plausibility[i])}, ${c.cells[i]} cells` }],
      bars: c.belief.flatMap((v, i) => v === null || seen[i] === null ? [] : [{ m, x: v, low: v, high: c.plausibility[i] }]) });
  }
  for (const box of document.querySelectorAll("[data-method]")) box.hidden = !shown.has(Number(box.dataset.method));
}

let rangeMetric = "";
function byRange(place) {
  const keys = [...new Set(D.byRange.flatMap(r => Object.keys(r)))].filter(key => key !== "cells");
  if (!keys.length || D.ranges.length < 2) return;
  rangeMetric ||= keys.includes("iou_free") ? "iou_free" : keys[0];
  const text = D.ranges.slice(0, -1).map((low, i) => D.ranges[i + 1] === null ? `> ${low}` : `${low}–${D.ranges[i + 1]}`);
  const series = shownMethods().flatMap(m => D.byRange[m.k][rangeMetric] ? [{ m, x: text.map((_, i) => i), y: D.byRange[m.k][rangeMetric], dots: 6, note: i => `${text[i]} m, ${D.byRange[m.k].cells?.[i] ?? "?"} cells` }] : []);
  const range = extent(series.map(s => s.y)) ?? [0, 1];
  tile(place, "By range", "Distance of the cells from the sensor. ", { x: { min: -0.3, max: text.length - 0.7, label: "distance [m]", ticks: text.map((t, at) => ({ at, text: t })) }, y: { min: Math.min(0, range[0]), max: range[1] * 1.08 || 1, label: title(rangeMetric) }, series });
  const select = node("select", { id: "range-metric", "aria-label": "Metric by range" }, ...keys.map(key => option(key, title(key) + sign(key))));
  select.value = rangeMetric;
  select.addEventListener("change", () => { rangeMetric = select.value; curves(); $("range-metric").focus(); });
  place.lastChild.querySelector("p").append(select);
}

// ---------- pairs

function pairOf(a, b) {  // what a gains over b; the page carries each pair one way round
  if (D.paired[`${a} ${b}`]) return D.paired[`${a} ${b}`];
  const other = D.paired[`${b} ${a}`];
  if (!other) return null;
  const turned = v => v === null ? null : v === 0 ? null : 1 / v, minus = v => v === null ? null : -v;
  return Object.fromEntries(Object.entries(other).map(([metric, [n, w, t, l, p, d, dl, dh, r, rl, rh]]) => [metric, [n, l, t, w, p, minus(d), minus(dh), minus(dl), turned(r), turned(rh), turned(rl)]]));
}

function pairs() {
  const b = Number($("reference").value), rival = $("rival").value;
  const span = (v, low, high) => [format(v), ...(low === null || high === null ? [] : [node("small", {}, `${format(low)} – ${format(high)}`)])];
  const significance = (metric, row) => row[6] === null || row[7] === null || row[6] * row[7] <= 0 || row[4] === null || row[4] >= 0.05 ? null : (row[5] < 0) === (D.metrics[metric].better === "lower") ? "best" : "worse";
  let head, rows;
  if (rival === "all") {
    const metrics = D.headline.filter(m => D.metrics[m].better);
    head = ["method", ...metrics.map(m => title(m) + sign(m))];
    rows = METHODS.filter(m => m.k !== b).map(m => {
      const pair = pairOf(m.k, b);
      return node("tr", {}, node("th", { scope: "row" }, swatch(m), m.name), ...metrics.map(metric => {
        const row = pair?.[metric];
        if (!row || !row[0]) return node("td", { class: "none" }, "–");
        return node("td", { class: significance(metric, row), title: `${row[1]} wins, ${row[2]} ties, ${row[3]} losses` }, `${row[1]} : ${row[3]}`, node("small", {}, row[8] === null ? "no ratio" : `× ${format(row[8])}`), node("small", {}, `p ${formatP(row[4])}`));
      }));
    });
  } else {
    const pair = pairOf(Number(rival), b) ?? {};
    head = ["metric", "wins", "ties", "losses", "difference of means", "ratio of means", "p"];
    rows = Object.entries(pair).map(([metric, row]) => node("tr", {}, node("th", { scope: "row", title: D.metrics[metric]?.description }, title(metric) + sign(metric)),
      ...(row[0] ? [row[1], row[2], row[3]].map(v => node("td", {}, String(v))) : [1, 2, 3].map(() => node("td", { class: "none" }, "–"))),
      node("td", { class: significance(metric, row) }, ...span(row[5], row[6], row[7])), node("td", {}, ...span(row[8], row[9], row[10])), node("td", {}, formatP(row[4]))));
  }
  $("paired-table").replaceChildren(node("table", { class: "scores" }, node("thead", {}, node("tr", {}, ...head.map(text => node("th", { scope: "col" }, text)))), node("tbody", {}, ...rows)),
    node("p", { class: "reason" }, `${rival === "all" ? "Wins : losses, × ratio of means, p. " : ""}Green: significantly better than the reference, orange: significantly worse; the 95 % interval of the mean difference leaves out zero and p is below 0.05.`));
}

function pairControls() {
  if (METHODS.length < 2) { $("paired").hidden = true; return; }
  $("rival").append(option("all", "all methods"));
  for (const m of METHODS) { $("reference").append(option(m.k, m.name)); $("rival").append(option(m.k, m.name)); }
  for (const id of ["reference", "rival"]) $(id).addEventListener("change", () => {
    if ($("rival").value === $("reference").value) $("rival").value = "all";
    pairs();
  });
  pairs();
}

// ---------- the frame browser

let frame = 0;
const hasPictures = D.pictures.length > 0;
const browsable = new Set(hasPictures ? D.pictures : D.frames.keys());

function ranking() {  // all frames in the browser's order; those without a value come last
  const metric = $("sort-metric").value, order = D.frames.map((_, i) => i);
  if (!D.perFrame[metric]) return order;
  const values = D.perFrame[metric][Number($("sort-method").value)];
  const rising = (D.metrics[metric].better === "higher") === ($("sort-way").value === "worst");
  return order.sort((a, b) => (values[a] === null) - (values[b] === null) || (rising ? values[a] - values[b] : values[b] - values[a]) || a - b);
}
const orderText = () => D.perFrame[$("sort-metric").value] ? `${$("sort-way").value} ${title($("sort-metric").value)} of ${METHODS[Number($("sort-method").value)].name} first` : "in the order of the data";
const route = () => ranking().filter(f => browsable.has(f));

function step(by) {
  const way = route(), here = way.indexOf(frame);
  if (here >= 0) return go(way[Math.min(Math.max(here + by, 0), way.length - 1)]);
  const full = ranking(), at = full.indexOf(frame);  // a frame without pictures: on to the next that has some
  const next = by > 0 ? full.slice(at).find(f => browsable.has(f)) : full.slice(0, at).reverse().find(f => browsable.has(f));
  return next === undefined ? undefined : go(next);
}

function go(number, quiet = false) {
  frame = number;
  const way = route(), here = way.indexOf(frame);
  $("place").textContent = here < 0 ? `no pictures; ${way.length} frames have some` : `${here + 1} of ${way.length}`;
  if (!$("pick").querySelector(`option[value="${frame}"]`)) $("pick").append(option(frame, D.frames[frame][0]));
  $("pick").value = frame;
  draw();
  mark();
  const hash = `#frame=${encodeURIComponent(D.frames[frame][0])}`;
  if (!quiet && location.hash !== hash) try { history.replaceState(null, "", hash); } catch { /* a browser that forbids it for files */ }
}

function fill() {  // the list of frames, in the browser's order
  $("pick").replaceChildren(...route().map(f => option(f, D.frames[f][0])));
  $("sort-method").disabled = $("sort-way").disabled = !D.perFrame[$("sort-metric").value];
}

function overlay(axes = false) {  // the vehicle and a scale over a picture, in metres; axes on request
  const [nx, ny] = D.grid.shape, side = D.grid.resolution, [x0, y0] = D.grid.origin;
  const length = nx * side, width = ny * side, cx = width + y0, cy = length + x0, u = Math.min(length, width) / 100;
  const bar = [50, 20, 10, 5, 2, 1, 0.5].find(b => b <= width * 0.4) ?? width / 4;
  const svg = node("svg", { viewBox: `0 0 ${width} ${length}`, "aria-hidden": "true", preserveAspectRatio: "none" });
  if (cx > 0 && cx < width && cy > 0 && cy < length) svg.append(node("path", { d: `M${cx} ${cy - 3 * u}l${2.1 * u} ${5 * u}h${-4.2 * u}z`, fill: "#fff", stroke: "#000", "stroke-width": 0.5 * u }));
  svg.append(node("path", { d: `M${3 * u} ${length - 3.2 * u}h${bar}m0 ${-1.2 * u}v${2.4 * u}m${-bar} 0v${-2.4 * u}`, stroke: "#fff", "stroke-width": 0.7 * u, fill: "none" }),
    node("text", { x: 3 * u, y: length - 5.5 * u, fill: "#fff", stroke: "#000", "stroke-width": 0.9 * u, "paint-order": "stroke", style: `font-size:${5.5 * u}px` }, `${bar} m`));
  const label = (x, y, text, anchor) => node("text", { x, y, fill: "#fff", stroke: "#000", "stroke-width": 0.5 * u, "paint-order": "stroke", "text-anchor": anchor, style: `font-size:${2.6 * u}px` }, text);
  if (axes) for (let v = Math.ceil(Math.min(x0, y0) / bar) * bar; v < Math.max(x0 + length, y0 + width); v += bar) {
    const x = cx - v, y = cy - v;  // left of, before the vehicle
    if (y > 4 * u && y < length - 9 * u) svg.append(node("path", { d: `M${width} ${y}h${-1.6 * u}`, stroke: "#fff", "stroke-width": 0.5 * u }), label(width - 2.2 * u, y + 0.9 * u, `${v} m`, "end"));
    if (x > 4 * u && x < width - 6 * u) svg.append(node("path", { d: `M${x} 0v${1.6 * u}`, stroke: "#fff", "stroke-width": 0.5 * u }), label(x, 4.4 * u, `${v} m`, "middle"));
  }
  return svg;
}

function picture(source, text, badge) {
  const [nx, ny] = D.grid.shape;
  const image = node("img", { src: source, alt: text, width: ny, height: nx });
  image.addEventListener("load", () => { image.style.imageRendering = image.clientWidth > 1.2 * image.naturalWidth ? "pixelated" : "auto"; });
  const box = node("button", { class: "view", type: "button", title: text, style: `aspect-ratio:${ny}/${nx}`, "data-badge": badge }, image, overlay(), node("span", {}, badge));
  box.addEventListener("click", () => enlarge(badge, text));
  return box;
}

function draw() {
  const pictures = read(`pictures-${frame}`), name = D.frames[frame][0], methods = shownMethods();
  const tiles = [];
  if (pictures) {
    const first = node("div", { class: "tile" }, node("h3", {}, pictures.points ? "Points and truth" : "Truth"));
    if (pictures.points) first.append(picture(pictures.points, `points of ${name}, coloured by height`, "points"));
    first.append(picture(pictures.truth, `truth of ${name}`, "truth"));
    const shares = ["free", "occupied", "unknown", "ignored"].filter(s => D.truth[s]);
    first.append(node("dl", {}, ...shares.map(s => node("div", {}, node("dt", {}, s), node("dd", {}, D.truth[s][frame] === null ? "–" : `${(100 * D.truth[s][frame]).toFixed(1)} %`)))));
    tiles.push(first);
  }
  const sorted = $("sort-metric").value, numbers = D.perFrame[sorted] && !NUMBERS.includes(sorted) ? [sorted, ...NUMBERS] : NUMBERS;
  const best = Object.fromEntries(numbers.map(metric => {
    const values = methods.map(m => D.perFrame[metric][m.k][frame]).filter(v => v !== null);
    return [metric, values.length < 2 ? null : D.metrics[metric].better === "lower" ? Math.min(...values) : Math.max(...values)];
  }));
  for (const m of methods) {
    const box = node("div", { class: "tile" }, node("h3", { title: m.name }, swatch(m), node("span", {}, m.name)));
    if (pictures?.[`mass ${m.k}`]) box.append(picture(pictures[`mass ${m.k}`], `masses of ${m.name} in ${name}`, "masses"));
    if (pictures?.[`motion ${m.k}`]) box.append(picture(pictures[`motion ${m.k}`], `motion in ${m.name} in ${name}`, "motion"));
    if (pictures?.[`error ${m.k}`]) box.append(picture(pictures[`error ${m.k}`], `errors of ${m.name} in ${name}`, "errors"));
    box.append(node("dl", {}, ...numbers.map(metric => {
      const v = D.perFrame[metric][m.k][frame];
      return node("div", { title: D.metrics[metric].description }, node("dt", {}, title(metric) + sign(metric)), node("dd", { class: v !== null && v === best[metric] && D.metrics[metric].better ? "best" : null }, format(v)));
    })));
    tiles.push(box);
  }
  $("no-pictures").hidden = Boolean(pictures);
  $("no-pictures").textContent = hasPictures ? "No pictures of this frame were kept: only its numbers." : "This report was made without pictures: only the numbers of every frame.";
  $("stage").replaceChildren(...tiles);
  columns();
  if ($("large").open) enlarge(...large);
}

function columns() {  // as many pictures side by side as fit, and none much larger than asked for
  const size = Number($("size").value), fit = Math.max(1, Math.floor(($("stage").clientWidth + 4) / (size + 12)));
  const count = Math.max(1, $("stage").children.length), rows = Math.ceil(count / fit);
  $("stage").style.gridTemplateColumns = `repeat(${Math.ceil(count / rows)}, minmax(0, ${1.25 * size}px))`;
}

let large = [];  // which picture is enlarged: its place among those of its kind
function enlarge(badge, text) {
  const kind = [...$("stage").querySelectorAll(`[data-badge="${badge}"]`)];
  const at = typeof text === "number" ? text : kind.findIndex(box => box.title === text);
  const box = kind[at];
  if (!box) return $("large").close();
  large = [badge, at];
  const [nx, ny] = D.grid.shape, copy = node("div", { class: "view", style: `aspect-ratio:${ny}/${nx};height:min(80vh,${(90 * nx / ny).toFixed(2)}vw);width:auto` }, box.querySelector("img").cloneNode(), overlay(true));
  copy.firstChild.style.imageRendering = "pixelated";
  $("large-picture").replaceChildren(copy);
  $("large-caption").textContent = `${box.title}; right: x, forward, top: y, left`;
  if (!$("large").open) $("large").showModal();
}

function browser() {
  $("sort-metric").append(option("", "in their order"));
  for (const metric of Object.keys(D.perFrame)) if (D.metrics[metric].better) $("sort-metric").append(option(metric, `by ${title(metric)}${sign(metric)}`));
  for (const m of METHODS) $("sort-method").append(option(m.k, m.name));
  for (const id of ["sort-metric", "sort-method", "sort-way"]) $(id).addEventListener("change", () => {
    fill();
    go(route()[0] ?? 0);
    if ($("order").value === "browser") frameFigures();
  });
  $("pick").addEventListener("change", event => go(Number(event.target.value)));
  for (const [id, by] of [["first", -1e9], ["previous", -1], ["next", 1], ["last", 1e9]]) $(id).addEventListener("click", () => step(by));
  $("size").addEventListener("input", columns);
  fill();
}

function linked() {  // the frame of "#frame=NAME", if there is one
  const match = /^#frame=(.*)$/.exec(location.hash);
  if (!match) return -1;
  let name = match[1];
  try { name = decodeURIComponent(name); } catch { /* not encoded: as it is */ }
  return D.frames.findIndex(f => f[0] === name);
}

// ---------- keys, theme, tables

function keys(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest?.("input:not([type=checkbox]), select, textarea")) return;
  const inside = $("frames").contains(document.activeElement) || $("large").open;
  const act = {
    ArrowRight: () => step(1), j: () => step(1), ArrowLeft: () => step(-1), k: () => step(-1),
    t: theme, "?": () => $("help").open ? $("help").close() : $("help").showModal(),
    ...(inside ? { ArrowDown: () => step(10), ArrowUp: () => step(-10), Home: () => step(-1e9), End: () => step(1e9) } : {}),
  }[event.key];
  if (act) { event.preventDefault(); act(); }
}

function theme() {
  const root = document.documentElement;
  const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  root.dataset.theme = dark ? "light" : "dark";
}

function sortable(table) {
  [...table.tHead.rows[0].cells].forEach((cell, column) => cell.querySelector("button")?.addEventListener("click", () => {
    const falling = cell.getAttribute("aria-sort") === "ascending", value = row => row.cells[column].dataset.v;
    for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
    cell.setAttribute("aria-sort", falling ? "descending" : "ascending");
    const body = table.tBodies[0], sorted = [...body.rows].sort((a, b) => {
      const u = value(a), v = value(b);
      if (u === undefined || v === undefined) return (u === undefined) - (v === undefined);
      return (column ? u - v : u.localeCompare(v)) * (falling ? -1 : 1);
    });
    body.append(...sorted);
  }));
}

function all() {
  $("shown-count").textContent = `shown: ${shown.size} of ${METHODS.length}`;
  $("key").replaceChildren(...shownMethods().map(m => node("span", {}, swatch(m), m.name)));
  frameFigures();
  curves();
  draw();
}

chooser();
figureControls();
pairControls();
browser();
document.querySelectorAll("table.sortable").forEach(sortable);
document.addEventListener("keydown", keys);
$("theme").addEventListener("click", theme);
$("ask").addEventListener("click", () => $("help").showModal());
addEventListener("hashchange", () => { const f = linked(); if (f >= 0 && f !== frame) go(f); });
let folded = [];  // printing opens what is folded
addEventListener("beforeprint", () => { folded = [...document.querySelectorAll("main details:not([open])")]; for (const d of folded) d.open = true; });
addEventListener("afterprint", () => { for (const d of folded) d.open = false; });
let width = innerWidth, timer = 0;
addEventListener("resize", () => { clearTimeout(timer); timer = setTimeout(() => { if (width !== innerWidth) { width = innerWidth; all(); } }, 120); });
if (METHODS.length > 12 || innerWidth < 700) $("chooser").open = METHODS.length <= 12 && innerWidth >= 700;
const start = linked();
frame = start >= 0 ? start : route()[0] ?? 0;
all();
go(frame, start < 0);
if (start >= 0) $("frames").scrollIntoView();
})();
