"use strict";
const $ = id => document.getElementById(id);
const data = JSON.parse($("data").textContent);
const NONE = -1e9, TRUTH = "Ground truth", MOST = 4, names = [TRUTH, ...data.methods];
const measured = data.metrics.map((_, n) => n).filter(n => data.frames.some(f => f.v[n].some(value => value !== null)));
const phone = matchMedia("(max-width: 40rem)"), metrics = data.metrics, frames = data.frames;
document.documentElement.classList.add("scripted");

function make(name, properties, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(properties || {})) {
    if (key.includes("-") || key === "role") element.setAttribute(key, value);
    else element[key] = value;
  }
  element.append(...children.filter(child => child !== null));
  return element;
}
function draw(name, attributes, text) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const key in attributes) element.setAttribute(key, attributes[key]);
  if (text !== undefined) element.textContent = text;
  return element;
}
const short = (text, most = 24) => text.length > most ? text.slice(0, most - 1) + "…" : text;
const shown = (value, metric) => value === null ? "–" : `${value.toFixed(metric.digits)} ${metric.unit}`.trim();
const shape = m => data.shapes[data.marks[m] % data.shapes.length], tint = m => `m${data.marks[m] % data.shapes.length}`;
const hollow = m => data.marks[m] >= data.shapes.length ? " hollow" : "";
function mark(m) {
  const svg = draw("svg", {class: `mark ${tint(m)}${hollow(m)}`, viewBox: "0 0 12 12", "aria-hidden": "true"});
  svg.append(draw("path", {d: shape(m)}));
  return svg;
}
const markAt = (m, x, y, size = 11) => draw("path", {d: shape(m), class: `shape ${tint(m)}${hollow(m)}`, transform: `translate(${x - size / 2} ${y - size / 2}) scale(${size / 12})`});
const dashes = m => data.marks[m] % 2 ? "6 3" : "none";
function choice(box, name, texts, chosen, act) { // a group of radio buttons
  box.append(...texts.map(([value, text]) => {
    const input = make("input", {type: "radio", name, value, checked: value === chosen});
    input.addEventListener("change", () => act(value));
    return make("label", {}, input, make("span", {textContent: text}));
  }));
  return box;
}
const check = (name, value) => { for (const input of document.querySelectorAll(`input[name="${name}"]`)) input.checked = input.value === String(value); };
function selectOf(title, id, texts, chosen, act) {
  const select = make("select", {id});
  select.append(...texts.map(([value, text]) => make("option", {value, textContent: text})));
  select.value = chosen;
  select.addEventListener("change", () => act(+select.value));
  return make("label", {className: "field"}, make("span", {textContent: title}), select);
}
const group = (id, title) => make("fieldset", {className: "choice", id}, make("legend", {className: "unseen", textContent: title}));
const say = text => { $("status").textContent = text; };

// What is shown. Frames of a task, subject and camera stand in order of sequences and time.
const state = {frame: 0, methods: [], metric: 0, wipe: false, against: 0, border: 0.5, errors: false, scale: 50, zoom: 1, x: 0, y: 0, keys: true};
const at = () => frames[state.frame].at;
const unique = list => [...new Set(list)];
let series = [], stops = [], timer = 0, held = false;
const order = (a, b) => frames[a].at[2] - frames[b].at[2] || frames[a].at[4] - frames[b].at[4];
function collect() {
  const [task, subject, , camera] = at();
  series = frames.map((_, i) => i).filter(i => frames[i].at[0] === task && frames[i].at[1] === subject && frames[i].at[3] === camera).sort(order);
  stops = series.filter(i => frames[i].p);
  if (!stops.length) stops = series;
}
function nearest(place) { // of the frames with pictures, the one nearest to a place in the series
  return stops.reduce((best, i) => Math.abs(series.indexOf(i) - place) < Math.abs(series.indexOf(best) - place) ? i : best, stops[0]);
}
function closest(list, wanted) { // of some frames, one like the current one, with pictures if there is any
  const [, subject, sequence, camera, timestep] = wanted;
  const cost = i => (frames[i].p ? 0 : 1e9) + (frames[i].at[1] !== subject) * 1e7 + (frames[i].at[3] !== camera) * 1e6 + (frames[i].at[2] !== sequence) * 1e5 + Math.abs(frames[i].at[4] - timestep);
  return list.reduce((best, i) => cost(i) < cost(best) ? i : best, list[0]);
}
const where = i => {
  const [, subject, sequence, camera, timestep] = frames[i].at, camera_ = data.cameras[camera];
  return `${data.subjects.length > 1 ? data.subjects[subject] + " " : ""}${data.sequences[sequence]} ${timestep}, camera ${camera_.length > 5 ? "…" + camera_.slice(-3) : camera_}`;
};

// The address holds the state, so that a view can be sent.
let waiting = 0;
function remember() {
  clearTimeout(waiting);
  waiting = setTimeout(() => {
    const [task, subject, sequence, camera, timestep] = at(), words = new URLSearchParams();
    Object.entries({task: data.tasks[task], subject: data.subjects[subject], sequence: data.sequences[sequence], camera: data.cameras[camera], timestep}).forEach(([key, value]) => words.set(key, value));
    for (const m of state.methods) words.append("method", data.methods[m]);
    if (metrics[state.metric]) words.set("metric", metrics[state.metric].label);
    if (state.errors) words.set("errors", state.scale);
    if (state.wipe) { words.set("wipe", names[state.against]); words.set("border", state.border.toFixed(3)); }
    if (state.zoom > 1) words.set("zoom", [state.zoom, state.x, state.y].map(v => +v.toFixed(4)).join("_"));
    if (!state.keys) words.set("keys", "off");
    try { history.replaceState(null, "", "#" + words); } catch { /* a frame without an address of its own */ }
  }, 300);
}
function recall() {
  if (!location.hash.includes("=")) return false;
  const words = new URLSearchParams(location.hash.slice(1));
  const place = [["task", data.tasks], ["subject", data.subjects], ["sequence", data.sequences], ["camera", data.cameras]].map(([key, texts]) => texts.indexOf(words.get(key)));
  const found = frames.findIndex(f => place.every((p, i) => f.at[i] === p) && f.at[4] === +words.get("timestep"));
  if (found < 0) return false;
  state.frame = found;
  const methods = words.getAll("method").map(name => data.methods.indexOf(name)).filter(m => m >= 0).slice(0, MOST);
  if (methods.length) state.methods = unique(methods);
  state.metric = Math.max(0, metrics.findIndex(m => m.label === words.get("metric")));
  state.errors = words.has("errors");
  if (SCALES.includes(+words.get("errors"))) state.scale = +words.get("errors");
  state.wipe = words.has("wipe");
  state.against = Math.max(0, names.indexOf(words.get("wipe")));
  state.border = Math.min(1, Math.max(0, +(words.get("border") ?? 0.5) || 0));
  const [zoom, x, y] = (words.get("zoom") || "1_0_0").split("_").map(Number);
  if ([zoom, x, y].every(Number.isFinite)) Object.assign(state, {zoom: Math.min(32, Math.max(1, zoom)), x, y});
  state.keys = words.get("keys") !== "off";
  return true;
}
const SCALES = [10, 20, 32, 50, 100, 255];

// Pictures in files beside the page: each file is a script that calls addPictures. The last few are kept.
const files = new Map(), wanted = {};
let images = null;
function addPictures(file, pictures) { wanted[file](pictures); }
function fileOf(file) {
  if (!files.has(file)) {
    files.set(file, new Promise((resolve, reject) => {
      wanted[file] = resolve;
      const script = make("script", {src: data.files[file][0]});
      script.addEventListener("load", () => script.remove());
      script.addEventListener("error", () => { script.remove(); files.delete(file); reject(new Error(`${data.files[file][0]} cannot be read`)); });
      document.head.append(script);
    }));
    if (files.size > 12) files.delete(files.keys().next().value);
  }
  return files.get(file);
}
async function bytesOf(index) {
  if (!data.files.length) return (images ??= JSON.parse($("images").textContent))[index];
  let file = 0;
  for (; index >= data.files[file][1]; file++) index -= data.files[file][1];
  return (await fileOf(file))[index];
}
const decoded = new Map(); // kept for a while
function picture(index) {
  if (!decoded.has(index)) {
    decoded.set(index, bytesOf(index).then(text => {
      const image = new Image();
      image.src = "data:image/webp;base64," + text;
      return image.decode().then(() => image);
    }));
    decoded.get(index).catch(() => decoded.delete(index));
    if (decoded.size > 400) decoded.delete(decoded.keys().next().value);
  }
  return decoded.get(index);
}
function pixels(image) {
  const canvas = make("canvas", {width: image.width, height: image.height}), context = canvas.getContext("2d", {willReadFrequently: true});
  context.drawImage(image, 0, 0);
  return context.getImageData(0, 0, image.width, image.height);
}
function errorMap(truth, image) { // absolute differences, mean over channels, on the colour scale
  const a = pixels(truth).data, made = pixels(image), b = made.data, scale = 255 / (3 * state.scale);
  for (let i = 0; i < b.length; i += 4) {
    const sum = Math.abs(a[i] - b[i]) + Math.abs(a[i + 1] - b[i + 1]) + Math.abs(a[i + 2] - b[i + 2]);
    const c = data.colours[Math.min(255, Math.round(sum * scale))];
    b[i] = c[0]; b[i + 1] = c[1]; b[i + 2] = c[2];
  }
  const canvas = make("canvas", {width: made.width, height: made.height});
  canvas.getContext("2d").putImageData(made, 0, 0);
  return canvas;
}
// What a tile shows: a picture or an error map of it (something to draw), or why there is none.
async function content(i, index, errors) {
  const frame = frames[i], place = frame.p ? frame.p[index] : NONE;
  if (place < 0) return {reason: place === NONE ? "This frame has values but no pictures in this file." : data.reasons[-1 - place]};
  try {
    const image = await picture(place);
    if (!errors || index === 0) return {image};
    return frame.p[0] < 0 ? {reason: "No error map without ground truth."} : {image: errorMap(await picture(frame.p[0]), image)};
  } catch (error) {
    return {reason: error.message};
  }
}
function paint(canvas, image) {
  canvas.width = image.width;
  canvas.height = image.height;
  canvas.getContext("2d").drawImage(image, 0, 0);
}

// Tiles: the ground truth and up to four methods, or in a wipe each method against one other.
let tiles = [], tileKey = "";
function tileOf(index) {
  const canvas = make("canvas", {width: 1, height: 1, role: "img"}), reason = make("p", {className: "reason", hidden: true});
  const cursor = make("div", {className: "cursor"}), wiper = make("div", {className: "wiper", hidden: true});
  const sides = ["side", "side right"].map(className => make("span", {className, hidden: true}));
  const box = make("div", {className: "view"}, canvas, reason, ...sides, cursor, wiper), caption = make("figcaption");
  const one = {index, canvas, reason, cursor, wiper, sides, box, caption, figure: make("figure", {className: "tile"}, caption, box)};
  box.addEventListener("dblclick", e => zoomBy(2, ...inside(box, e)));
  wiper.addEventListener("pointerdown", e => { wiper.setPointerCapture(e.pointerId); e.stopPropagation(); });
  wiper.addEventListener("pointermove", e => {
    if (!wiper.hasPointerCapture(e.pointerId)) return;
    setBorder((inside(box, e)[0] - state.x) / state.zoom);
    e.stopPropagation();
  });
  return one;
}
const inside = (box, e) => { const r = box.getBoundingClientRect(); return [(e.clientX - r.left) / r.width, (e.clientY - r.top) / r.height]; };
function layOut() {
  const list = state.wipe ? state.methods.map(m => m + 1) : [0, ...state.methods.map(m => m + 1)], key = list.join();
  if (key === tileKey) return;
  tileKey = key;
  const known = new Map(tiles.map(tile => [tile.index, tile]));
  tiles = list.map(index => known.get(index) || tileOf(index));
}
function captionOf(tile, i) {
  const metric = metrics[state.metric];
  if (!tile.index) {
    const kind = frames[i].p && frames[i].p[0] >= 0 ? frames[i].l ? "lossless" : "lossy" : "";
    return [make("b", {textContent: TRUTH}), make("span", {className: "less", textContent: kind})];
  }
  const values = frames[i].v[state.metric] || [], value = values[tile.index - 1] ?? null;
  const found = [mark(tile.index - 1), make("b", {textContent: names[tile.index]})];
  if (!metric || value === null) return found;
  const own = state.methods.map(m => values[m]).filter(v => v !== null), best = metric.up ? Math.max(...own) : Math.min(...own);
  const leads = own.length > 1 && value.toFixed(metric.digits) === best.toFixed(metric.digits);
  found.push(make("span", {className: leads ? "best" : "value", textContent: value.toFixed(metric.digits)}), make("span", {textContent: metric.unit}));
  if (own.length > 1 && !leads) found.push(make("span", {className: "less", textContent: `${value > best ? "+" : "−"}${Math.abs(value - best).toFixed(metric.digits)}`}));
  return found;
}
let turn = 0;
async function show() {
  if (!frames.length) return;
  const mine = ++turn, i = state.frame;
  layOut();
  const list = tiles, errors = state.errors && !held;
  const [other, ...contents] = await Promise.all([state.wipe ? content(i, state.against, errors) : null, ...list.map(tile => content(i, held ? 0 : tile.index, errors))]);
  if (mine !== turn) return;
  const size = contents.map(c => c.image).find(Boolean);
  const figures = $("tiles");
  if (figures.children.length !== list.length || list.some((tile, n) => figures.children[n] !== tile.figure)) figures.replaceChildren(...list.map(tile => tile.figure));
  const root = document.documentElement.style;
  root.setProperty("--tiles", phone.matches && list.length === 1 ? 1 : list.length);
  if (size) root.setProperty("--ratio", `${size.width} / ${size.height}`);
  const metric = metrics[state.metric];
  list.forEach((tile, n) => {
    const {image, reason} = contents[n], wiping = state.wipe && image && other.image && tile.index !== state.against;
    tile.reason.textContent = reason || "";
    tile.reason.hidden = !reason;
    if (image) paint(tile.canvas, image);
    if (wiping) {
      const edge = Math.round(tile.canvas.width * state.border);
      if (edge) tile.canvas.getContext("2d").drawImage(other.image, 0, 0, edge, other.image.height, 0, 0, edge, other.image.height);
    }
    tile.wiper.hidden = !wiping;
    tile.sides.forEach((side, k) => { side.hidden = !wiping; side.textContent = names[k ? tile.index : state.against]; });
    tile.box.classList.toggle("errors", errors && tile.index > 0);
    tile.caption.replaceChildren(...captionOf(tile, i));
    const value = tile.index && metric ? `, ${metric.label} ${shown(frames[i].v[state.metric][tile.index - 1], metric)}` : "";
    const what = wiping ? `${names[state.against]} to the left of the border, ${names[tile.index]} to the right` : `${errors && tile.index ? "Error map of " : ""}${held ? TRUTH : names[tile.index]}`;
    tile.canvas.setAttribute("aria-label", `${what}, ${where(i)}${value}`);
  });
  place();
  $("where").textContent = `${where(i)}, frame ${series.indexOf(i) + 1} of ${series.length}`;
  $("scrub").max = Math.max(0, series.length - 1);
  $("scrub").value = series.indexOf(i);
  $("scrub").setAttribute("aria-valuetext", where(i));
  curve();
  for (const button of document.querySelectorAll("#worst button")) button.setAttribute("aria-current", button.frame === i);
  remember();
}
function go(i) {
  const before = at();
  state.frame = i;
  if (before[0] !== at()[0] || before[1] !== at()[1] || before[3] !== at()[3] || !series.length) { collect(); controls(); }
  return show();
}
const step = by => { const n = stops.indexOf(state.frame); return go(n < 0 ? nearest(series.indexOf(state.frame)) : stops[(n + by + stops.length) % stops.length]); };

// One zoom for all tiles; a cursor in each.
function place() {
  state.x = Math.min(0, Math.max(1 - state.zoom, state.x));
  state.y = Math.min(0, Math.max(1 - state.zoom, state.y));
  for (const {canvas, box, wiper} of tiles) {
    canvas.style.transform = state.zoom > 1 ? `translate(${100 * state.x}%, ${100 * state.y}%) scale(${state.zoom})` : "";
    box.classList.toggle("near", state.zoom > 1);
    box.classList.toggle("pixels", state.zoom * box.clientWidth > 6 * canvas.width);
    wiper.style.left = `${100 * (state.border * state.zoom + state.x)}%`;
  }
  if ($("zoom")) $("zoom").textContent = `${+state.zoom.toFixed(1)}×`;
}
function zoomBy(factor, x = 0.5, y = 0.5) {
  const next = Math.min(32, Math.max(1, state.zoom * factor));
  state.x = x - (x - state.x) * next / state.zoom;
  state.y = y - (y - state.y) * next / state.zoom;
  state.zoom = next;
  place();
  remember();
}
function setBorder(value) {
  state.border = Math.min(1, Math.max(0, value));
  if ($("border")) $("border").value = 100 * state.border;
  show();
}
const pointers = new Map();
let start = null;
$("stage").addEventListener("pointerdown", e => {
  const box = e.target.closest(".view");
  if (!box) return;
  pointers.set(e.pointerId, e);
  start = pointers.size === 1 ? {x: e.clientX, y: e.clientY, time: e.timeStamp, swipe: e.pointerType === "touch" && state.zoom === 1} : null;
  if (e.pointerType === "mouse") box.setPointerCapture(e.pointerId);
});
$("stage").addEventListener("pointermove", e => {
  const box = e.target.closest(".view"), before = pointers.get(e.pointerId);
  if (box && e.pointerType === "mouse") {
    const [x, y] = inside(box, e);
    for (const {cursor} of tiles) Object.assign(cursor.style, {visibility: "visible", left: `${100 * x}%`, top: `${100 * y}%`});
  }
  if (!before || !box) return;
  const r = box.getBoundingClientRect();
  if (pointers.size === 2) {
    const [other] = [...pointers].filter(([id]) => id !== e.pointerId).map(([, event]) => event);
    const far = (a, b) => Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY) || 1;
    zoomBy(far(e, other) / far(before, other), ((e.clientX + other.clientX) / 2 - r.left) / r.width, ((e.clientY + other.clientY) / 2 - r.top) / r.height);
  } else if (state.zoom > 1) {
    state.x += (e.clientX - before.clientX) / r.width;
    state.y += (e.clientY - before.clientY) / r.height;
    place();
    remember();
  }
  pointers.set(e.pointerId, e);
});
for (const kind of ["pointerup", "pointercancel"]) $("stage").addEventListener(kind, e => {
  pointers.delete(e.pointerId);
  if (kind === "pointerup" && start && start.swipe && state.zoom === 1) {
    const dx = e.clientX - start.x, dy = e.clientY - start.y;
    if (Math.abs(dx) > 40 && Math.abs(dx) > 2 * Math.abs(dy)) step(dx < 0 ? 1 : -1);
  }
  start = null;
});
$("stage").addEventListener("pointerleave", () => { for (const {cursor} of tiles) cursor.style.visibility = "hidden"; });
$("stage").addEventListener("wheel", e => {
  const box = e.target.closest(".view");
  if (!box || !(e.ctrlKey || $("stage").contains(document.activeElement))) return;
  e.preventDefault();
  zoomBy(Math.exp(-e.deltaY * (e.deltaMode ? 0.06 : 0.002)), ...inside(box, e));
}, {passive: false});
$("stage").tabIndex = 0;

// Drawings: axes with round numbers, labels beside the ends of their lines.
function ticks(low, high, count = 4) {
  const rough = (high - low) / count || 1, power = 10 ** Math.floor(Math.log10(rough));
  const by = [1, 2, 5, 10].find(k => k * power >= 0.7 * rough) * power, found = [];
  for (let i = Math.ceil(low / by); i * by <= high + 1e-9; i++) found.push(+(i * by).toPrecision(10));
  return found;
}
function spread(labels, gap, low, high) {
  labels.sort((a, b) => a.y - b.y);
  labels.forEach((l, i) => { l.at = Math.max(l.y, i ? labels[i - 1].at + gap : low); });
  for (let i = labels.length - 1, limit = high; i >= 0; i--) { labels[i].at = Math.min(labels[i].at, limit); limit = labels[i].at - gap; }
  return labels;
}
function axes(W, H, margins, ys, label, text = t => t) {
  const box = {l: margins.l, r: W - margins.r, t: margins.t, b: H - margins.b}, svg = draw("svg", {viewBox: `0 0 ${W} ${H}`, height: H, role: "img", "aria-label": label});
  let low = Math.min(...ys), high = Math.max(...ys);
  const margin = (high - low || Math.abs(high) || 1) * 0.08;
  low -= margin; high += margin;
  const y = v => box.b - (v - low) / (high - low) * (box.b - box.t);
  for (const t of ticks(low, high)) {
    svg.append(draw("line", {class: "grid", x1: box.l, x2: box.r, y1: y(t), y2: y(t)}), draw("text", {x: box.l - 8, y: y(t) + 4, "text-anchor": "end"}, text(t)));
  }
  return {svg, box, y};
}
function ends(svg, box, labels) {
  for (const l of spread(labels, 16, box.t, box.b)) {
    svg.append(markAt(l.m, box.r + 14, l.at, 9));
    const text = draw("text", {x: box.r + 24, y: l.at + 4, class: "halo"});
    text.append(draw("tspan", {class: "strong", "font-weight": 600}, short(l.name, 14) + " "), draw("tspan", {}, l.text));
    svg.append(text);
  }
}
let curveKey = "", cursorLine = null, readings = null;
function curve() {
  const metric = metrics[state.metric], W = Math.round($("curve").clientWidth);
  if (!metric || !W) return;
  const L = 42, R = phone.matches ? 10 : 150, H = phone.matches ? 130 : 150, last = series.length - 1;
  const x = n => L + (last ? n / last : 0.5) * (W - L - R);
  const key = [W, state.metric, state.methods, series[0], series.length].join();
  if (key !== curveKey) {
    curveKey = key;
    const ys = series.flatMap(i => state.methods.map(m => frames[i].v[state.metric][m])).filter(v => v !== null);
    if (!ys.length) { $("curve").replaceChildren(make("p", {className: "note", textContent: `No values of ${metric.label} here.`})); cursorLine = null; return; }
    const {svg, box, y} = axes(W, H, {l: L, r: R, t: 10, b: 24}, ys, `${metric.label} of the methods shown, frame by frame; marks stand on each method's worst frame`);
    const starts = series.map((i, n) => n).filter(n => n === 0 || frames[series[n]].at[2] !== frames[series[n - 1]].at[2]);
    starts.forEach((n, k) => {
      const to = k + 1 < starts.length ? starts[k + 1] : last + 1;
      if (n) svg.append(draw("line", {class: "grid", x1: x(n - 0.5), x2: x(n - 0.5), y1: box.t, y2: H}));
      const room = x(to - 1) - x(n) + (last ? (W - L - R) / last : W) - 4, text = data.sequences[frames[series[n]].at[2]];
      if (room > 56) svg.append(draw("text", {x: n ? x(n - 0.5) + 5 : x(n), y: H - 5}, short(text, Math.max(3, Math.floor(room / 7)))));
    });
    for (const m of state.methods) {
      const value = n => frames[series[n]].v[state.metric][m];
      starts.forEach((from, k) => {
        const points = [];
        for (let n = from; n < (k + 1 < starts.length ? starts[k + 1] : last + 1); n++) if (value(n) !== null) points.push(`${x(n)},${y(value(n))}`);
        if (points.length > 1) svg.append(draw("polyline", {class: `line ${tint(m)}`, points: points.join(" "), "stroke-dasharray": dashes(m)}));
        else if (points.length) svg.append(draw("circle", {class: `shape ${tint(m)}`, cx: points[0].split(",")[0], cy: points[0].split(",")[1], r: 4}));
      });
      const known = series.map((_, n) => n).filter(n => value(n) !== null);
      if (known.length > 2) {
        const worst = known.reduce((a, b) => (metric.up ? value(b) < value(a) : value(b) > value(a)) ? b : a);
        svg.append(markAt(m, x(worst), y(value(worst))));
      }
    }
    cursorLine = draw("line", {class: "now", y1: box.t - 6, y2: box.b});
    readings = draw("g", {});
    svg.append(cursorLine, readings);
    $("curve").replaceChildren(svg);
    Object.assign(cursorLine, {x, y, box});
    $("scrub").style.marginLeft = `${L - 8}px`;
    $("scrub").style.width = `${W - L - R + 16}px`;
  }
  if (!cursorLine) return;
  const now = cursorLine.x(series.indexOf(state.frame));
  for (const end of ["x1", "x2"]) cursorLine.setAttribute(end, now);
  readings.replaceChildren();
  const labels = [];
  for (const m of state.methods) {
    const value = frames[state.frame].v[state.metric][m];
    if (value === null) continue;
    readings.append(draw("circle", {class: tint(m), cx: now, cy: cursorLine.y(value), r: 3, fill: "currentColor"}));
    labels.push({m, y: cursorLine.y(value), name: data.methods[m], text: value.toFixed(metric.digits)});
  }
  if (!phone.matches) ends(readings, cursorLine.box, labels);
}
function scrubAt(e) {
  const r = $("curve").getBoundingClientRect(), L = 42, R = phone.matches ? 10 : 150;
  const i = nearest((e.clientX - r.left - L) / (r.width - L - R) * (series.length - 1));
  if (i !== state.frame) go(i);
}
$("curve").addEventListener("pointerdown", e => { $("curve").setPointerCapture(e.pointerId); scrubAt(e); });
$("curve").addEventListener("pointermove", e => { if ($("curve").hasPointerCapture(e.pointerId)) scrubAt(e); });

// Quality against cost. Each label takes the first of four places that nothing else covers.
let costTask = data.plots.length ? data.plots[0].task : "";
function plots() {
  const kept = data.plots.filter(plot => plot.task === costTask);
  $("plots").replaceChildren(...kept.map(() => make("div")));
  kept.forEach((plot, n) => {
    const parent = $("plots").children[n], W = Math.max(260, Math.round(parent.clientWidth)), H = 300;
    const xs = plot.points.map(p => Math.log10(p[1])), low = Math.min(...xs), high = Math.max(...xs);
    const [title, unit] = plot.x.split(/ \(|\)/), points = plot.points.map(p => ({m: data.methods.indexOf(p[0]), name: p[0], cost: p[1], quality: p[2]}));
    const {svg, box, y} = axes(W, H, {l: 42, r: 12, t: 12, b: 40}, points.map(p => p.quality), `${plot.title}: ${points.map(p => `${p.name} ${p.quality.toPrecision(4)} at ${p.cost.toPrecision(3)} ${unit}`).join("; ")}`);
    const x = v => box.l + 24 + (high > low ? (Math.log10(v) - low) / (high - low) : 0.5) * (box.r - box.l - 90);
    let before = -Infinity;
    for (let e = Math.floor(low); e <= high + 1; e++) for (const k of [1, 2, 5]) {
      const t = k * 10 ** e;
      if (x(t) < box.l || x(t) > box.r || x(t) < before + 34) continue;
      before = x(t);
      svg.append(draw("text", {x: x(t), y: box.b + 18, "text-anchor": "middle"}, +t.toPrecision(3)));
    }
    svg.append(draw("text", {x: box.l, y: H - 4}, `${plot.y}, upwards`), draw("text", {x: box.r, y: H - 4, "text-anchor": "end"}, `${unit || title}, logarithmic`));
    svg.append(draw("polyline", {class: "front", points: plot.front.map(i => [x(points[i].cost), y(points[i].quality)]).join(" ")}));
    const taken = points.map(p => [x(p.cost) - 8, y(p.quality) - 8, x(p.cost) + 8, y(p.quality) + 8]);
    for (const p of points) {
      const px = x(p.cost), py = y(p.quality), name = short(p.name, 18), text = ` ${+p.cost.toPrecision(3)} ${unit}`, width = 7.2 * (name.length + text.length);
      const places = [[px + 11, py - 7, "start"], [px - 11, py - 7, "end"], [px + 11, py + 16, "start"], [px - 11, py + 16, "end"], [px - width / 2, py - 14, "start"], [px - width / 2, py + 24, "start"]];
      const rect = ([tx, ty, anchor]) => anchor === "end" ? [tx - width, ty - 11, tx, ty + 3] : [tx, ty - 11, tx + width, ty + 3];
      const bad = r => (r[0] < box.l - 2 || r[2] > W || r[1] < 0 || r[3] > box.b ? 10 : 0) + taken.filter(t => t[0] < r[2] && r[0] < t[2] && t[1] < r[3] && r[1] < t[3]).length;
      const best = places.reduce((a, b) => bad(rect(b)) < bad(rect(a)) ? b : a);
      taken.push(rect(best));
      const label = draw("text", {x: best[0], y: best[1], "text-anchor": best[2], class: "halo"});
      label.append(draw("tspan", {class: "strong", "font-weight": 600}, name), draw("tspan", {}, text));
      svg.append(label);
    }
    for (const p of points) svg.append(markAt(p.m, x(p.cost), y(p.quality), 13));
    parent.append(make("h3", {textContent: plot.title}), svg, make("p", {className: "note", textContent: `On the front: ${plot.front.map(i => points[i].name).join(", ")}.`}));
  });
}
function losses() {
  const W = Math.round($("losses").clientWidth);
  if (!W || !data.training.length) return;
  const points = data.training.flatMap(c => c.points), end = Math.max(...points.map(p => p[0]));
  const label = `Training loss over iterations, divided by the first one: ${data.training.map(c => `${data.methods[c.method]} ends at ${c.points.at(-1)[1]}`).join("; ")}`;
  const {svg, box, y} = axes(W, 280, {l: 52, r: phone.matches ? 80 : 150, t: 12, b: 40}, points.map(p => Math.log10(p[1])), label, t => +(10 ** t).toPrecision(2));
  const x = t => box.l + t / end * (box.r - box.l), labels = [];
  for (const t of ticks(0, end, Math.min(8, W / 90))) svg.append(draw("text", {x: x(t), y: box.b + 18, "text-anchor": "middle"}, t));
  svg.append(draw("text", {x: box.l, y: 276}, "loss, first = 1, logarithmic"), draw("text", {x: box.r, y: 276, "text-anchor": "end"}, "iteration"));
  for (const {method, points} of data.training) {
    svg.append(draw("polyline", {class: `line ${tint(method)}`, points: points.map(p => [x(p[0]), y(Math.log10(p[1]))]).join(" "), "stroke-dasharray": dashes(method)}));
    labels.push({m: method, y: y(Math.log10(points.at(-1)[1])), name: data.methods[method], text: ""});
  }
  ends(svg, box, labels);
  $("losses").replaceChildren(svg);
}

// Frames worth a look: one camera for each moment.
const valued = data.methods.map((_, m) => m).filter(m => frames.some(f => f.v.length && f.v[0][m] !== null));
const scored = valued.filter(m => !data.trivial.includes(data.methods[m])), offered = scored.length ? scored : valued;
let worstOf = "all";
function moments(score, most) { // frames with pictures of highest score, one for each task, subject, sequence and timestep
  const seen = new Map();
  frames.forEach((f, i) => {
    const value = f.p ? score(f) : null, moment = [f.at[0], f.at[1], f.at[2], f.at[4]].join();
    if (value !== null && !(seen.has(moment) && seen.get(moment)[0] >= value)) seen.set(moment, [value, i]);
  });
  return [...seen.values()].sort((a, b) => b[0] - a[0]).slice(0, most);
}
function places() {
  const metric = metrics[state.metric], v = f => f.v[state.metric];
  if (!metric) return [];
  const sign = metric.up ? -1 : 1, bad = m => f => v(f)[m] === null ? null : sign * v(f)[m];
  if (worstOf === "apart") {
    const own = f => state.methods.map(m => v(f)[m]).filter(value => value !== null);
    return moments(f => own(f).length > 1 ? Math.max(...own(f)) - Math.min(...own(f)) : null, 10).map(([value, i]) => {
      const sorted = state.methods.filter(m => v(frames[i])[m] !== null).sort((a, b) => bad(a)(frames[i]) - bad(b)(frames[i]));
      return {i, methods: [sorted[0], sorted.at(-1)], text: `${value.toFixed(metric.digits)} ${metric.unit} apart`};
    });
  }
  const list = worstOf === "all" ? offered.flatMap(m => moments(bad(m), offered.length > 5 ? 2 : 3).map(([value, i]) => ({value, i, methods: [m]}))) : moments(bad(+worstOf), 10).map(([value, i]) => ({value, i, methods: [+worstOf]}));
  return list.sort((a, b) => b.value - a.value).map(one => ({...one, text: shown(sign * one.value, metric)}));
}
async function thumbnails(button) {
  const {frame, methods} = button, pair = button.querySelectorAll("canvas");
  const wantedPair = methods.length > 1 ? methods.map(m => content(frame, m + 1, false)) : [content(frame, 0, false), content(frame, methods[0] + 1, true)];
  (await Promise.all(wantedPair)).forEach(({image}, n) => image && paint(pair[n], image));
}
function strip() {
  const chosen = places();
  $("worst").replaceChildren(...chosen.map(({i, methods, text}) => {
    const button = make("button", {type: "button"}), task = data.tasks[frames[i].at[0]];
    button.append(make("span", {className: "pair", "aria-hidden": "true"}, make("canvas"), make("canvas")),
      make("span", {className: "line"}, ...methods.flatMap(m => [mark(m), make("b", {textContent: data.methods[m]})]), make("span", {textContent: text})),
      make("span", {className: "note", textContent: `${where(i)}${data.tasks.length > 1 ? `, ${task.toLowerCase()}` : ""}`}));
    Object.assign(button, {frame: i, methods});
    button.setAttribute("aria-current", i === state.frame);
    button.addEventListener("click", () => pick(button));
    return make("li", {}, button);
  }));
  $("worst-frames").hidden = !metrics.length;
  fill([...document.querySelectorAll("#worst button")]);
}
async function fill(buttons) { // one after the other, so that a scrub meanwhile does not wait
  for (const button of buttons) if (button.isConnected) await thumbnails(button);
}
function pick({frame, methods}) {
  for (const m of methods) if (!state.methods.includes(m)) state.methods = [...state.methods.slice(0, MOST - 1), m];
  go(frame).then(controls);
  $("pictures").scrollIntoView({block: "start"});
  $("stage").focus({preventScroll: true});
}

// Controls.
function toggle(m) {
  const list = state.methods;
  if (list.includes(m)) { if (list.length > 1) state.methods = list.filter(other => other !== m); }
  else state.methods = [...list.slice(list.length >= MOST ? 1 : 0), m];
  say(`Shown: ${state.methods.map(n => data.methods[n]).join(", ")}`);
  update();
}
function update() { controls(); show(); if (worstOf === "apart") strip(); }
const visible = data.methods.map((_, m) => m).sort((a, b) => data.marks[a] - data.marks[b]);
let folded = scored.length > 1 && data.trivial.length > 0; // trivial baselines stand behind one button until they are asked for
function controls() {
  const active = document.activeElement?.id, [task, subject, , camera] = at(), all = frames.map((_, i) => i), box = $("choices");
  const of = (depth, value, rest) => all.filter(i => frames[i].at[depth] === value && rest(frames[i].at));
  const tasks = choice(group("task", "Task"), "task", data.tasks.map((text, n) => [String(n), text]), String(task), value => go(closest(of(0, +value, () => true), at())));
  const subjects = unique(all.filter(i => frames[i].at[0] === task).map(i => frames[i].at[1])).sort((a, b) => a - b);
  const cameras = unique(of(0, task, a => a[1] === subject).map(i => frames[i].at[3])).sort((a, b) => a - b);
  const chips = make("div", {className: "chips", role: "group", "aria-label": "Methods shown, four at most"});
  const there = visible.filter(m => !folded || !data.trivial.includes(data.methods[m]) || state.methods.includes(m));
  chips.append(...there.map(m => {
    const n = visible.indexOf(m);
    const chip = make("button", {type: "button", className: "chip", id: `chip-${m}`, title: data.methods[m], "aria-pressed": state.methods.includes(m)}, mark(m), make("span", {textContent: data.methods[m]}), n < 9 ? make("kbd", {textContent: n + 1, "aria-hidden": "true"}) : null);
    chip.addEventListener("click", () => toggle(m));
    return chip;
  }));
  if (there.length < visible.length) {
    const more = make("button", {type: "button", className: "chip", id: "more", textContent: `+${visible.length - there.length} baseline${visible.length - there.length > 1 ? "s" : ""}`});
    more.addEventListener("click", () => { folded = false; controls(); $(`chip-${visible.find(m => !there.includes(m))}`).focus(); });
    chips.append(more);
  }
  const modes = choice(group("mode", "How methods are compared"), "mode", [["side", "Side by side"], ["wipe", "Wipe"]], state.wipe ? "wipe" : "side", value => { state.wipe = value === "wipe"; update(); });
  const errors = make("input", {type: "checkbox", id: "errors", checked: state.errors, role: "switch"});
  errors.addEventListener("change", () => { state.errors = errors.checked; update(); });
  const end = make("div", {className: "end"}, modes);
  if (state.wipe) {
    const border = make("input", {type: "range", id: "border", min: 0, max: 100, value: 100 * state.border, "aria-label": "Border of the wipe"});
    border.addEventListener("input", () => setBorder(border.value / 100));
    end.append(selectOf("against", "against", names.map((text, n) => [n, short(text)]), state.against, value => { state.against = value; update(); }), border);
  }
  end.append(make("label", {className: "switch"}, errors, "Error maps"));
  box.replaceChildren(...[data.tasks.length > 1 ? tasks : null,
    data.subjects.length > 1 ? selectOf("Subject", "subject", subjects.map(n => [n, data.subjects[n]]), subject, value => go(closest(of(0, task, a => a[1] === value), at()))) : null,
    selectOf("Camera", "camera", cameras.map(n => [n, data.cameras[n]]), camera, value => go(closest(of(0, task, a => a[1] === subject && a[3] === value), at()))),
    chips, end].filter(Boolean));
  $("tools").querySelector("#scale-box").hidden = !state.errors;
  check("metric", state.metric);
  if (active && $(active) && box.contains($(active))) $(active).focus();
}
function play() {
  clearInterval(timer);
  timer = timer ? 0 : setInterval(() => { if (!document.hidden) step(1); }, 160);
  $("play").textContent = timer ? "❚❚" : "▶";
  $("play").setAttribute("aria-label", timer ? "Pause" : "Play the frames");
}
function tools() {
  const button = (id, text, label, act) => { const made = make("button", {type: "button", className: "plain", id, textContent: text, "aria-label": label}); made.addEventListener("click", act); return made; };
  const metric = choice(group("metric", "Metric of the curve"), "metric", measured.map(n => [String(n), metrics[n].label]), String(state.metric), value => { state.metric = +value; show(); strip(); });
  const legend = make("canvas", {id: "legend", width: 256, height: 1, role: "img", "aria-label": "Colours of error maps, from none to the largest"}), colours = legend.getContext("2d");
  data.colours.forEach((c, i) => { colours.fillStyle = `rgb(${c})`; colours.fillRect(i, 0, 1, 1); });
  const scale = make("span", {id: "scale-box", className: "field", hidden: true}, "0", legend, selectOf("", "scale", SCALES.map(v => [v, `${v} levels`]), state.scale, value => { state.scale = value; show(); strip(); }));
  scale.querySelector("select").setAttribute("aria-label", "Brightest colour of error maps, 8-bit levels, mean over channels");
  const zoom = make("span", {className: "zoom"}, button("further", "−", "Zoom out", () => zoomBy(1 / 1.5)), make("output", {id: "zoom", textContent: "1×"}), button("closer", "+", "Zoom in", () => zoomBy(1.5)), button("whole", "⤢", "Whole picture", whole));
  $("tools").append(button("play", "▶", "Play the frames", play), metric, make("span", {id: "where"}), make("div", {className: "end"}, scale, zoom, button("keys-help", "?", "Keys", () => $("help").showModal())));
}
function whole() { Object.assign(state, {zoom: 1, x: 0, y: 0}); place(); remember(); }
function schemes() {
  const texts = ["as the system", "light", "dark"], root = document.documentElement;
  let n = 0;
  $("scheme").addEventListener("click", () => {
    n = (n + 1) % 3;
    if (n) root.dataset.theme = texts[n]; else delete root.dataset.theme;
    $("scheme").setAttribute("aria-label", `Colour scheme: ${texts[n]}`);
    say(`Colour scheme: ${texts[n]}`);
  });
}
function nextOf(list, value) { return list[(list.indexOf(value) + 1) % list.length]; }
const KEYS = {
  ArrowLeft: () => step(-1), ArrowRight: () => step(1), " ": play, "?": () => $("help").showModal(), 0: whole,
  e: () => { state.errors = !state.errors; say(state.errors ? "Error maps" : "Renders"); update(); },
  w: () => { state.wipe = !state.wipe; say(state.wipe ? "Wipe" : "Side by side"); update(); },
  t: () => { if (!held) { held = true; show(); } },
  c: () => { const [task, subject, , camera] = at(), own = frames.map((_, i) => i).filter(i => frames[i].at[0] === task && frames[i].at[1] === subject); const next = nextOf(unique(own.map(i => frames[i].at[3])).sort((a, b) => a - b), camera); go(closest(own.filter(i => frames[i].at[3] === next), at())); },
  n: () => { const list = [...document.querySelectorAll("#worst button")]; if (list.length) pick(nextOf(list, list.find(b => b.frame === state.frame))); },
  "+": () => zoomBy(1.5), "=": () => zoomBy(1.5), "-": () => zoomBy(1 / 1.5),
};
document.addEventListener("keydown", e => {
  if (e.key === "Escape" && $("stage").contains(document.activeElement)) document.activeElement.blur();
  if (!state.keys || e.ctrlKey || e.metaKey || e.altKey || $("help").open || e.target.matches("select, textarea, pre, input:not([type=checkbox]), .wide")) return;
  if (e.key === " " && !e.target.matches("body, #stage")) return;
  const m = /^[1-9]$/.test(e.key) ? visible[e.key - 1] : undefined, act = m === undefined ? KEYS[e.key] : () => toggle(m);
  if (act) { act(); e.preventDefault(); }
});
document.addEventListener("keyup", e => { if (e.key === "t" && held) { held = false; show(); } });
$("scrub").addEventListener("input", () => go(nearest(+$("scrub").value)));
$("close").addEventListener("click", () => $("help").close());
$("keys").addEventListener("change", () => { state.keys = $("keys").checked; remember(); });
addEventListener("hashchange", () => { if (recall()) { collect(); update(); } });

// Parts of the frames in the table.
const parts = [...document.querySelectorAll("article.table")];
const showPart = n => parts.forEach((part, k) => part.classList.toggle("chosen", k === n));
showPart(0);
if ($("part")) {
  $("part").append(...parts.map((part, n) => make("option", {value: n, textContent: part.dataset.title})));
  $("part").addEventListener("change", () => showPart(+$("part").value));
}

$("facts").open = !phone.matches;
schemes();
if (frames.length) {
  state.frame = data.opening.frame ?? 0;
  state.methods = data.opening.methods.length ? data.opening.methods : offered.slice(0, 3);
  if (!state.methods.length) state.methods = data.methods.length ? [0] : [];
  recall();
  $("keys").checked = state.keys;
  tools();
  collect();
  controls();
  choice($("worst-of"), "worst-of", [["all", "All methods"], ...offered.map(m => [String(m), short(data.methods[m])]), ["apart", "Largest differences"]], "all", value => { worstOf = value; strip(); });
  show().then(strip);
} else for (const id of ["pictures", "worst-frames"]) $(id).hidden = true;
const plotted = unique(data.plots.map(plot => plot.task));
if (plotted.length) {
  if (plotted.length > 1) choice($("cost-of"), "cost-of", plotted.map(task => [task, task]), costTask, value => { costTask = value; plots(); });
  plots();
} else $("cost").hidden = true;
if (!data.training.length) $("training").hidden = true;
$("training").addEventListener("toggle", losses);
let width = innerWidth;
addEventListener("resize", () => { if (width !== innerWidth) { width = innerWidth; curve(); plots(); losses(); place(); } });
