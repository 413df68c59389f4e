"use strict";
// The page's script: unpacks the tiles that are on the screen, paints them, and shows the values under the pointer.
// Places: u, v [cells] from the left and the front edge of the grid; pixels are those of the screen. Nothing is loaded.
(() => {
const $ = id => document.getElementById(id);
const D = JSON.parse($("data").textContent);
const [ROWS, COLUMNS] = D.shape, RES = D.resolution, T = D.tile, [X0, Y0] = D.origin;
const TOP = Math.max(0, Math.ceil(Math.log2(Math.max(ROWS, COLUMNS) / D.roughest)));  // the last level, one tile
const CLOSEST = 160;  // pixels along a cell
const canvas = $("map"), context = canvas.getContext("2d", { alpha: false });
const fail = text => {
  const note = document.createElement("p");
  note.id = "failed";
  note.setAttribute("role", "alert");
  note.textContent = text;
  document.body.append(note);
};

// ---------- tiles: unpacked when they are wanted, dropped when they have not been for the longest time

class Kept extends Map {
  constructor(most) { super(); this.most = most; }
  take(key) {
    const value = super.get(key);
    if (value !== undefined) { this.delete(key); this.set(key, value); }
    return value;
  }
  put(key, value) {
    this.set(key, value);
    for (const old of this.keys()) { if (this.size <= this.most) break; this.delete(old); }
  }
}
const LEAST = 96;
const bytes = new Kept(LEAST), pictures = new Kept(LEAST), loading = new Set();
const NOTHING = new Uint8Array(0);

async function unpack(text) {
  const raw = atob(text), packed = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) packed[i] = raw.charCodeAt(i);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Promises the bytes of a tile; null where the page has none. Pages of maps that are served have a function of their own.
const loadTile = window.loadTile || (key => { const place = $(key); return place && unpack(place.textContent); });

// Returns the bytes of a tile, NOTHING where it holds none, undefined until they are unpacked.
function tile(stored, level, row, column) {
  const key = `${stored}/${level}/${row}/${column}`, found = bytes.take(key);
  if (found !== undefined || loading.has(key) || loading.size >= 8) return found;
  const coming = loadTile(key);
  if (coming === null) { bytes.put(key, NOTHING); return NOTHING; }
  loading.add(key);
  coming.then(
    got => { loading.delete(key); bytes.put(key, got.length ? got : NOTHING); redraw(); },
    error => {
      bytes.put(key, NOTHING);
      loading.delete(key);
      fail(window.loadTile ? `A tile is not shown: ${error.message}` : `A tile of this page is damaged (${error.message}): make the page again.`);
      redraw();
    },
  );
  return undefined;
}
const sizeOf = (count, level, index) => Math.min(T, Math.ceil(count / 2 ** level) - index * T);

// ---------- colours

const tableOf = text => Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
for (const layer of D.layers) layer.tables = layer.tables.map(tableOf);
const NUMBERS = D.stored.map(one => Float64Array.from({ length: 256 }, (_, byte) => byte < one.first ? NaN : one.low + (byte - one.first) * one.step));
const INDEX = {  // of the table, by the bytes of free and of occupied
  unknown: (free, occupied) => 255 - free - occupied,
  probability: (free, occupied) => 255 + occupied - free,
  state: (free, occupied) => occupied > 255 - free - occupied && occupied >= free ? 2 : free > 255 - free - occupied && free > occupied ? 1 : 0,
};

// Returns the colour of a cell as 0xBBGGRR, from the bytes that the layer is of.
function painter(layer) {
  const [first, second, third] = layer.tables;
  if (layer.paint === "velocity") {
    const number = NUMBERS[layer.of[0][0]], most = layer.fastest || 1;
    return (a, b) => {
      const x = number[a] || 0, y = number[b] || 0, at = 3 * (Math.round(Math.atan2(y, x) / Math.PI * 128) & 255);
      const light = Math.sqrt(Math.min(1, Math.hypot(x, y) / most));
      return first[at] * light | (first[at + 1] * light) << 8 | (first[at + 2] * light) << 16;
    };
  }
  if (layer.paint === "motion") {  // the colours of belief, but of its heading what moves
    const [moves, number] = [NUMBERS[layer.of[2][0]], NUMBERS[layer.of[3][0]]];
    return (free, occupied, dynamic, a, b) => {
      const share = Number.isNaN(number[a]) ? 0 : moves[dynamic] || 0;
      const still = 3 * Math.max(0, occupied - Math.round(255 * share));
      const at = 3 * (Math.round(Math.atan2(number[b], number[a]) / Math.PI * 128) & 255);
      const mix = k => Math.min(255, Math.round(second[3 * free + k] + third[still + k] + share * first[at + k]));
      return mix(0) | mix(1) << 8 | mix(2) << 16;
    };
  }
  const index = INDEX[layer.paint];
  if (index) return (a, b) => { const at = 3 * index(a, b); return first[at] | first[at + 1] << 8 | first[at + 2] << 16; };
  const sum = (at, to, k) => Math.min(255, first[3 * at + k] + second[3 * to + k]);
  return second ? (a, b) => sum(a, b, 0) | sum(a, b, 1) << 8 | sum(a, b, 2) << 16
    : a => first[3 * a] | first[3 * a + 1] << 8 | first[3 * a + 2] << 16;
}
for (const layer of D.layers) { layer.colour = painter(layer); layer.nothing = layer.colour(0, 0, 0, 0, 0); }
const style = colour => `rgb(${colour & 255} ${colour >> 8 & 255} ${colour >> 16 & 255})`;

const keyOf = (layer, level, row, column) => `${D.layers.indexOf(layer)}/${level}/${row}/${column}`;

// Returns a tile as a picture, null where it is all in the layer's colour for zero, undefined until it can be painted.
function picture(layer, level, row, column, mayPaint) {
  const key = keyOf(layer, level, row, column), found = pictures.take(key);
  if (found !== undefined) return found;
  const parts = layer.of.map(([stored]) => tile(stored, level, row, column));
  if (parts.includes(undefined) || !mayPaint) return undefined;
  if (parts.every(part => part === NOTHING)) { pictures.put(key, null); return null; }
  const width = sizeOf(COLUMNS, level, column), height = sizeOf(ROWS, level, row), count = width * height;
  const cells = layer.of.map(([, k], part) => parts[part] === NOTHING ? new Uint8Array(count) : parts[part].subarray(k * count, (k + 1) * count));
  const image = new ImageData(width, height), out = new Uint32Array(image.data.buffer), colour = layer.colour;
  const [a, b, c, d, e] = cells;
  if (e) for (let i = 0; i < count; i++) out[i] = colour(a[i], b[i], c[i], d[i], e[i]) | 0xff000000;
  else if (b) for (let i = 0; i < count; i++) out[i] = colour(a[i], b[i]) | 0xff000000;
  else for (let i = 0; i < count; i++) out[i] = colour(a[i]) | 0xff000000;
  const made = document.createElement("canvas");
  made.width = width;
  made.height = height;
  made.getContext("2d").putImageData(image, 0, 0);
  pictures.put(key, made);
  return made;
}

// ---------- view

let layer = D.layers[0], scale = 0, u0 = COLUMNS / 2, v0 = ROWS / 2;  // pixels along a cell; the middle of the screen
let fitted = true, probe = null, byKeys = false, dirty = false;
const ratio = () => window.devicePixelRatio || 1;
const toX = u => (u - u0) * scale + canvas.width / 2, toY = v => (v - v0) * scale + canvas.height / 2;
const toU = x => (x - canvas.width / 2) / scale + u0, toV = y => (y - canvas.height / 2) / scale + v0;
const between = (low, value, high) => Math.min(high, Math.max(low, value));
const farthest = () => Math.min(canvas.width / COLUMNS, canvas.height / ROWS) * 0.94;
const closest = () => Math.max(CLOSEST * ratio(), farthest());

function moveTo(u, v) { u0 = between(0, u, COLUMNS); v0 = between(0, v, ROWS); redraw(); }
function zoom(factor, x = canvas.width / 2, y = canvas.height / 2) {
  const u = toU(x), v = toV(y);
  scale = between(farthest() / 2, scale * factor, closest());
  fitted = false;
  moveTo(u - (x - canvas.width / 2) / scale, v - (y - canvas.height / 2) / scale);
}
function fit() { scale = Math.min(farthest(), closest()); fitted = true; moveTo(COLUMNS / 2, ROWS / 2); }
function redraw() { if (!dirty) { dirty = true; requestAnimationFrame(draw); } }

// Draws the part of a picture that lies between some cells.
function blit(image, level, row, column, [left, right, front, back]) {
  const cell = 2 ** level, u = column * T, v = row * T;
  const a = Math.max(u, Math.floor(left / cell)), b = Math.min(u + image.width, Math.ceil(right / cell));
  const c = Math.max(v, Math.floor(front / cell)), d = Math.min(v + image.height, Math.ceil(back / cell));
  if (a >= b || c >= d) return;
  const x = Math.round(toX(a * cell)), y = Math.round(toY(c * cell));
  context.drawImage(image, a - u, c - v, b - a, d - c, x, y, Math.round(toX(b * cell)) - x, Math.round(toY(d * cell)) - y);
}

function draw() {
  dirty = false;
  const start = performance.now(), { width, height } = canvas;
  const level = between(0, Math.ceil(-Math.log2(scale) - 1e-6), TOP), span = T * 2 ** level;  // no cell is below a pixel
  const left = between(0, toU(0), COLUMNS), right = between(0, toU(width), COLUMNS);
  const front = between(0, toV(0), ROWS), back = between(0, toV(height), ROWS);
  const x = Math.round(toX(0)), y = Math.round(toY(0)), w = Math.round(toX(COLUMNS)) - x, h = Math.round(toY(ROWS)) - y;
  context.imageSmoothingEnabled = false;
  context.fillStyle = "#101317";
  context.fillRect(0, 0, width, height);
  context.save();
  context.beginPath();
  context.rect(x, y, w, h);
  context.clip();
  context.fillStyle = style(layer.nothing);
  context.fillRect(x, y, w, h);
  const rows = [Math.floor(front / span), Math.ceil(back / span)], columns = [Math.floor(left / span), Math.ceil(right / span)];
  const wanted = (rows[1] - rows[0]) * (columns[1] - columns[0]);
  bytes.most = pictures.most = Math.max(LEAST, 2 * wanted * D.stored.length);
  let missing = 0;
  for (let row = rows[0]; row < rows[1]; row++) for (let column = columns[0]; column < columns[1]; column++) {
    const area = [Math.max(left, column * span), Math.min(right, (column + 1) * span), Math.max(front, row * span), Math.min(back, (row + 1) * span)];
    const image = picture(layer, level, row, column, performance.now() - start < 25);
    if (image) blit(image, level, row, column, area);
    if (image !== undefined) continue;
    missing++;
    for (let up = level + 1; up <= TOP; up++) {  // in the meantime, what is there of a rougher level
      const above = up < TOP ? pictures.take(keyOf(layer, up, row >> up - level, column >> up - level)) : picture(layer, TOP, 0, 0, true);
      if (above) blit(above, up, row >> up - level, column >> up - level, area);
      if (above !== undefined) break;
    }
  }
  context.restore();
  decorate(x, y, w, h, [left, right, front, back]);
  readValues();
  describeScale(level);
  if (missing && !loading.size) redraw();
  document.body.dataset.state = missing ? "loading" : "ready";
  document.body.dataset.level = level;
  document.body.dataset.tiles = `${bytes.size} ${pictures.size}`;
  remember();
}

function decorate(x, y, w, h, [left, right, front, back]) {
  const unit = ratio();
  context.lineWidth = unit;
  if (scale >= 24 * unit) {  // lines between the cells
    context.strokeStyle = "rgb(128 140 155 / 0.35)";
    context.beginPath();
    for (let u = Math.ceil(left); u <= right; u++) { context.moveTo(Math.round(toX(u)) + 0.5, toY(front)); context.lineTo(Math.round(toX(u)) + 0.5, toY(back)); }
    for (let v = Math.ceil(front); v <= back; v++) { context.moveTo(toX(left), Math.round(toY(v)) + 0.5); context.lineTo(toX(right), Math.round(toY(v)) + 0.5); }
    context.stroke();
  }
  context.strokeStyle = "#4a5462";
  context.strokeRect(x - 0.5, y - 0.5, w + 1, h + 1);
  const screen = (px, py) => [toX(COLUMNS - (py - Y0) / RES), toY(ROWS - (px - X0) / RES)];
  const lines = (points, styles) => {
    for (const [colour, wide] of styles) {
      context.strokeStyle = colour;
      context.lineWidth = wide * unit;
      context.beginPath();
      for (const [from, to] of points) { context.moveTo(...from); context.lineTo(...to); }
      context.stroke();
    }
  };
  const track = (D.track || []).map(([px, py]) => screen(px, py));
  lines(track.slice(1).map((to, k) => [track[k], to]), [["#000", 3.5], ["#fff", 1.5]]);
  const [ox, oy] = screen(0, 0), arm = 6 * unit;
  lines([[[ox - arm, oy], [ox + arm, oy]], [[ox, oy - arm], [ox, oy + arm]]], [["#000", 4], ["#fff", 1.5]]);
  context.lineWidth = unit;
  if (D.vehicle) {
    const [px, py] = screen(D.vehicle[0], D.vehicle[1]), c = Math.cos(D.vehicle[2]), s = Math.sin(D.vehicle[2]);
    context.beginPath();
    for (const [dx, dy] of [[0, -10], [7, 7], [-7, 7]]) context.lineTo(px + (c * dx + s * dy) * unit, py + (c * dy - s * dx) * unit);
    context.closePath();
    context.fillStyle = "#fff";
    context.strokeStyle = "#000";
    context.fill();
    context.stroke();
  }
  for (const [ax, ay, dx, dy] of layer.arrows || []) {
    const column = COLUMNS - (ay - Y0) / RES, row = ROWS - (ax - X0) / RES;
    arrow(toX(column), toY(row), toX(column - dy / RES), toY(row - dx / RES), unit);
  }
  const at = place();
  if (!at) return;
  const cell = [Math.round(toX(Math.floor(at.u))), Math.round(toY(Math.floor(at.v))), Math.round(scale), Math.round(scale)];
  if (scale >= 6 * unit) for (const [colour, wide] of [["#000", 3], ["#fff", 1.5]]) {
    context.strokeStyle = colour;
    context.lineWidth = wide * unit;
    context.strokeRect(...cell);
  }
  if (byKeys) for (const [colour, wide] of [["#000", 3], ["#fff", 1.2]]) {
    const [px, py] = [toX(at.u), toY(at.v)], arm = 12 * unit;
    context.strokeStyle = colour;
    context.lineWidth = wide * unit;
    context.beginPath();
    context.moveTo(px - arm, py); context.lineTo(px + arm, py); context.moveTo(px, py - arm); context.lineTo(px, py + arm);
    context.stroke();
  }
}

function arrow(x0, y0, x1, y1, unit) {
  const length = Math.hypot(x1 - x0, y1 - y0), head = Math.min(length, 9 * unit);
  if (length === 0) return;
  const [ux, uy] = [(x1 - x0) / length, (y1 - y0) / length], [nx, ny] = [x1 - ux * head, y1 - uy * head];
  for (const [colour, wide] of [["#fff", 4.5], ["#000", 2]]) {
    context.strokeStyle = context.fillStyle = colour;
    context.lineWidth = wide * unit;
    context.beginPath();
    context.moveTo(x0, y0); context.lineTo(nx, ny);
    context.stroke();
    context.beginPath();
    context.moveTo(x1, y1); context.lineTo(nx - 0.45 * head * uy, ny + 0.45 * head * ux); context.lineTo(nx + 0.45 * head * uy, ny - 0.45 * head * ux);
    context.closePath();
    context.lineWidth = (wide - 2) * unit;
    if (wide > 2) context.stroke();
    context.fill();
  }
}

function describeScale(level) {
  const metre = scale / RES / ratio(), most = 150 / metre, power = 10 ** Math.floor(Math.log10(most));
  const length = [5, 2, 1].map(one => one * power).find(one => one <= most);
  $("scale-bar").style.width = `${length * metre}px`;
  $("scale-text").textContent = length >= 1000 ? `${length / 1000} km` : length < 1 ? `${+(length * 100).toPrecision(6)} cm` : `${length} m`;
  $("level").textContent = level ? `a pixel shows up to ${2 ** level} × ${2 ** level} cells; occupied ones stay visible` : "";
}

// ---------- values

const decimals = between(1, Math.ceil(-Math.log10(RES)) + 1, 5);
const digits = step => step > 0 ? between(0, Math.ceil(-Math.log10(step)), 8) : 3;
const lines = new Map();
function line(name, apart) {
  const row = document.createElement("tr"), head = document.createElement("th"), value = document.createElement("td");
  head.scope = "row";
  head.textContent = name;
  if (apart) row.className = "apart";
  row.append(head, value);
  $("values").tBodies[0].append(row);
  lines.set(name, value);
}
const MASSES = D.stored.findIndex(one => one.first === 0);
for (const name of ["x", "y", "cell"]) line(name);
D.stored.forEach((one, k) => {
  one.names.forEach((name, part) => line(name, part === 0 && (k === 0 || k - 1 === MASSES)));
  if (k === MASSES) for (const name of ["unknown", "probability", "state"]) line(name);
});

// Returns the place whose values are shown: under the pointer, or with keys in the middle.
function place() {
  const [x, y] = byKeys ? [canvas.width / 2, canvas.height / 2] : probe || [];
  if (x === undefined) return null;
  const u = toU(x), v = toV(y);
  return u >= 0 && u < COLUMNS && v >= 0 && v < ROWS ? { u, v, column: Math.floor(u), row: Math.floor(v) } : null;
}

function readValues() {
  const at = place(), show = (name, text) => { lines.get(name).textContent = text; };
  if (!at) { for (const cell of lines.values()) cell.textContent = "–"; return; }
  show("x", `${(X0 + (ROWS - at.v) * RES).toFixed(decimals)} m`);
  show("y", `${(Y0 + (COLUMNS - at.u) * RES).toFixed(decimals)} m`);
  show("cell", `(${ROWS - 1 - at.row}, ${COLUMNS - 1 - at.column})`);
  D.stored.forEach((one, k) => {
    const [row, column] = [Math.floor(at.row / T), Math.floor(at.column / T)], part = tile(k, 0, row, column);
    if (part === undefined) { for (const name of one.names) show(name, "…"); return; }
    const width = sizeOf(COLUMNS, 0, column), count = width * sizeOf(ROWS, 0, row), i = (at.row - row * T) * width + at.column - column * T;
    const found = one.names.map((_, p) => part === NOTHING ? 0 : part[p * count + i]);
    if (k !== MASSES) { one.names.forEach((name, p) => { const value = NUMBERS[k][found[p]]; show(name, one.labels?.[value] ?? format(value, one.step)); }); return; }
    const [free, occupied] = found;
    show("free", (free / 255).toFixed(3));
    show("occupied", (occupied / 255).toFixed(3));
    show("unknown", (INDEX.unknown(free, occupied) / 255).toFixed(3));
    show("probability", (INDEX.probability(free, occupied) / 510).toFixed(3));
    show("state", ["unknown", "free", "occupied"][INDEX.state(free, occupied)]);
  });
}
const format = (value, step) => Number.isNaN(value) ? "no value" : value.toFixed(digits(step));
let speaking = 0;
function speak() {  // for those who hear the page: after the last key
  clearTimeout(speaking);
  speaking = setTimeout(() => { $("spoken").textContent = [...lines].map(([name, cell]) => `${name} ${cell.textContent}`).join(", "); }, 400);
}

// ---------- layers and their legend

D.layers.forEach((one, k) => {
  const label = document.createElement("label"), input = document.createElement("input");
  Object.assign(input, { type: "radio", name: "layer", value: k });
  input.addEventListener("change", () => choose(k));
  label.append(input, one.name);
  if (k < 9) { const key = document.createElement("kbd"); key.textContent = k + 1; label.append(key); }
  $("layers").append(label);
});
function choose(k) {
  layer = D.layers[k];
  $("layers").querySelectorAll("input")[k].checked = true;
  const legend = $("legend"), list = document.createElement("ul");
  legend.replaceChildren();
  if (layer.shades.length) {
    const bar = document.createElement("div"), ends = document.createElement("div");
    bar.className = "bar";
    ends.className = "ends";
    bar.style.background = `linear-gradient(to right, ${layer.shades.map(one => `rgb(${one.join(" ")})`)})`;
    for (const text of layer.scale) { const end = document.createElement("span"); end.textContent = text; ends.append(end); }
    legend.append(bar, ends);
  }
  for (const [name, colour] of layer.swatches) {
    const entry = document.createElement("li"), patch = document.createElement("i");
    patch.style.background = `rgb(${colour.join(" ")})`;
    entry.append(patch, name);
    list.append(entry);
  }
  const text = document.createElement("p");
  text.className = "soft";
  text.textContent = layer.text;
  legend.append(list, text);
  redraw();
}
$("precision").textContent = D.stored.filter(one => !one.labels?.length).map(one => one.first === 0 ? "Masses are stored in steps of 1/255: free and occupied are at most 0.002 off, unknown 0.004."
  : `${one.names.join(", ")}: in steps of ${+one.step.toPrecision(3)}.`).join(" ");
if (MASSES >= 0) {
  const [free, occupied] = D.stored[MASSES].means, share = part => `${(100 * part).toFixed(1)} %`;
  $("shares").textContent = `mean: free ${share(free)}, occupied ${share(occupied)}, unknown ${share(Math.max(0, 1 - free - occupied))}`;
}

// ---------- input

const held = new Map();  // pointers that are down
const pixels = event => { const box = canvas.getBoundingClientRect(); return [(event.clientX - box.left) * ratio(), (event.clientY - box.top) * ratio()]; };
canvas.addEventListener("pointerdown", event => {
  canvas.setPointerCapture(event.pointerId);
  held.set(event.pointerId, pixels(event));
  canvas.classList.add("moving");
});
canvas.addEventListener("pointermove", event => {
  const now = pixels(event), before = held.get(event.pointerId);
  probe = now;
  byKeys = false;
  if (before) {
    const other = [...held].find(([id]) => id !== event.pointerId)?.[1];
    if (other) {
      const [wide, was] = [Math.hypot(now[0] - other[0], now[1] - other[1]), Math.hypot(before[0] - other[0], before[1] - other[1])];
      if (was > 0 && wide > 0) zoom(wide / was, other[0], other[1]);
    } else { fitted = false; moveTo(u0 - (now[0] - before[0]) / scale, v0 - (now[1] - before[1]) / scale); }
    held.set(event.pointerId, now);
  }
  redraw();
});
for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, event => {
  held.delete(event.pointerId);
  if (!held.size) canvas.classList.remove("moving");
});
canvas.addEventListener("pointerleave", () => { if (!held.size) { probe = null; redraw(); } });
canvas.addEventListener("wheel", event => {
  event.preventDefault();
  const lines = [1, 16, 400][event.deltaMode] * event.deltaY;
  zoom(Math.exp(-between(-240, lines, 240) * (event.ctrlKey ? 0.008 : 0.0022)), ...pixels(event));
}, { passive: false });
canvas.addEventListener("dblclick", event => zoom(2, ...pixels(event)));
$("in").addEventListener("click", () => zoom(1.5));
$("out").addEventListener("click", () => zoom(1 / 1.5));
$("fit").addEventListener("click", fit);

const MOVES = { ArrowUp: [0, -1], ArrowDown: [0, 1], ArrowLeft: [-1, 0], ArrowRight: [1, 0] };
addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const move = MOVES[event.key], number = Number(event.key), at = byKeys || !probe ? [] : probe;
  if (move && event.target.type === "radio") return;  // the arrows step through the layers
  if (move) {
    const step = event.shiftKey ? [1, 1] : [0.12 * canvas.width / scale, 0.12 * canvas.height / scale];
    fitted = false;
    byKeys = true;
    moveTo(u0 + move[0] * step[0], v0 + move[1] * step[1]);
  } else if (event.key === "+" || event.key === "=") zoom(1.25, ...at);
  else if (event.key === "-" || event.key === "_") zoom(0.8, ...at);
  else if (event.key === "0" || event.key === "Home") fit();
  else if (number >= 1 && number <= D.layers.length) choose(number - 1);
  else return;
  event.preventDefault();
  byKeys ||= !probe;
  redraw();
  speak();
});

// ---------- the address keeps the view: #x=12&y=-3&metre=8&layer=occupied

let remembering = 0;
function remember() {
  clearTimeout(remembering);
  remembering = setTimeout(() => {
    const part = { x: (X0 + (ROWS - v0) * RES).toFixed(decimals), y: (Y0 + (COLUMNS - u0) * RES).toFixed(decimals), metre: +(scale / RES / ratio()).toPrecision(4), layer: layer.name };
    const text = new URLSearchParams(fitted ? { layer: layer.name } : part);
    try { history.replaceState(null, "", `#${text}`); } catch { /* some browsers refuse it for files */ }
  }, 250);
}
function recall() {
  const asked = new URLSearchParams(location.hash.slice(1)), at = ["x", "y", "metre"].map(name => parseFloat(asked.get(name)));
  choose(Math.max(0, D.layers.findIndex(one => one.name === asked.get("layer"))));
  if (at.some(Number.isNaN)) { fit(); return; }
  scale = between(farthest() / 2, at[2] * RES * ratio(), closest());
  fitted = false;
  moveTo(COLUMNS - (at[1] - Y0) / RES, ROWS - (at[0] - X0) / RES);
}
addEventListener("hashchange", recall);

function resize() {
  const box = canvas.getBoundingClientRect();
  canvas.width = Math.max(1, Math.round(box.width * ratio()));
  canvas.height = Math.max(1, Math.round(box.height * ratio()));
  if (!scale) recall();
  else if (fitted) fit();
  else redraw();
}
if (typeof DecompressionStream === "undefined") fail("This browser cannot unpack the page: it needs Chrome 80, Firefox 113 or Safari 16.4, or newer.");
else new ResizeObserver(resize).observe(canvas);
})();
