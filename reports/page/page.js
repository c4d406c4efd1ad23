"use strict";
const $ = id => document.getElementById(id);
const data = JSON.parse($("data").textContent), images = JSON.parse($("images").textContent);
const NONE = -1e9, GROUND = "Ground truth", names = [GROUND, ...data.methods];
// Okabe and Ito's colours, trivial baselines after the others; yellow, faint on white, last.
const COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c8c8c", "#c9b800"];
const trivial = name => data.trivial.includes(name), turns = [...data.methods].sort((a, b) => trivial(a) - trivial(b));
const turn = m => turns.indexOf(data.methods[m]), colour = m => COLOURS[turn(m) % COLOURS.length];
const dash = m => ["", "7 3", "2 3"][Math.floor(turn(m) / COLOURS.length) % 3];
const PARTS = [["Task", data.tasks], ["Subject", data.subjects], ["Sequence", data.sequences], ["Camera", data.cameras]];
document.documentElement.classList.add("scripted");

function make(name, properties, ...children) {
  const element = document.createElement(name);
  Object.assign(element, properties);
  element.append(...children);
  return element;
}
function draw(name, attributes, text) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const key in attributes) element.setAttribute(key, attributes[key]);
  if (text !== undefined) element.textContent = text;
  return element;
}
function options(select, texts, chosen) {
  select.replaceChildren(...texts.map(([value, text]) => make("option", {value, textContent: text})));
  if (chosen !== undefined) select.value = chosen;
}
const short = text => text.length > 28 ? text.slice(0, 26) + "…" : text;
const numbered = texts => texts.map((text, index) => [index, text]);

for (const box of document.querySelectorAll("div.wide:not([role])")) { // scrolled by keys, too
  const title = box.parentElement.dataset.title || box.previousElementSibling?.textContent || "Table";
  Object.entries({role: "region", tabindex: 0, "aria-label": title}).forEach(pair => box.setAttribute(...pair));
}
// Tables: sorted by a column within methods and within baselines; the part of the frames.
for (const table of document.querySelectorAll("table:not(.text)")) {
  const heads = [...table.tHead.rows[table.tHead.rows.length - 1].cells];
  heads.forEach((head, column) => {
    const button = make("button", {type: "button"});
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const rising = head.getAttribute("aria-sort") === "descending" || (column === 0 && !head.hasAttribute("aria-sort"));
      heads.forEach(other => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", rising ? "ascending" : "descending");
      for (const body of table.tBodies) {
        const rows = [...body.rows].filter(row => !row.classList.contains("group"));
        const key = row => column ? parseFloat(row.cells[column].title) : row.cells[0].textContent;
        const missing = row => column !== 0 && Number.isNaN(key(row));
        const order = (a, b) => (key(a) < key(b) ? -1 : key(a) > key(b) ? 1 : 0) * (rising ? 1 : -1);
        rows.sort((a, b) => missing(a) - missing(b) || (missing(a) ? 0 : order(a, b)));
        body.append(...rows);
      }
    });
  });
}
const parts = [...document.querySelectorAll(".part")];
options($("part"), parts.map((part, index) => [index, part.dataset.title]));
const showPart = () => parts.forEach((part, index) => part.classList.toggle("chosen", index === +$("part").value));
$("part").addEventListener("change", showPart);
showPart();

// Frames: which are there, and which one is shown.
const frames = data.frames, selects = [];
let series = [], moments = [], now = null, timer = 0;
const matching = depth => frames.filter(f => selects.slice(0, depth).every((s, i) => f.at[i] === +s.value));
PARTS.forEach(([title, texts], depth) => {
  const select = make("select", {id: title.toLowerCase()});
  selects.push(select);
  $("choice").append(make("label", {}, title + " ", select));
  select.addEventListener("change", () => choose(depth + 1));
});
function choose(depth, wanted) {
  const before = now;
  for (let d = depth; d < PARTS.length; d++) {
    const there = new Set(matching(d).map(f => f.at[d]));
    const old = wanted ? wanted.at[d] : +selects[d].value;
    options(selects[d], numbered(PARTS[d][1]).filter(([index]) => there.has(index)));
    if (there.has(old)) selects[d].value = old;
  }
  series = matching(PARTS.length).sort((a, b) => a.at[4] - b.at[4]);
  moments = series.filter(f => f.p);
  if (!moments.length) moments = series;
  $("scrub").max = Math.max(0, moments.length - 1);
  show(wanted || nearest(before ? before.at[4] : -1));
}
const nearest = t => moments.reduce((best, f) => !best || Math.abs(f.at[4] - t) < Math.abs(best.at[4] - t) ? f : best, null);
function go(frame) {
  PARTS.forEach(([, texts], d) => { options(selects[d], numbered(texts)); selects[d].value = frame.at[d]; });
  choose(0, frame);
  $("viewer").scrollIntoView({block: "start"});
}
function step(by) {
  if (moments.length) show(moments[(moments.indexOf(now) + by + moments.length) % moments.length]);
}
const shown = (value, metric) => value === null ? "–" : `${value.toFixed(metric.digits)} ${metric.unit}`.trim();

// Pictures in files beside the page: each file is a script that calls addPictures. The last few are kept.
const files = new Map();
const wanted = {};
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
  if (!data.files.length) return images[index];
  let file = 0;
  for (; index >= data.files[file][1]; file++) index -= data.files[file][1];
  return (await fileOf(file))[index];
}
// Pictures, decoded once and kept for a while.
const decoded = new Map();
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
const views = [];
let zoom = 1, left = 0, top_ = 0;
function view(parent, title) {
  const canvas = make("canvas", {width: 1, height: 1}), reason = make("p", {className: "reason"});
  const box = make("div", {className: "view"}, canvas, reason), caption = make("figcaption");
  canvas.setAttribute("role", "img");
  parent.append(make("figure", {}, box, caption));
  const own = {canvas, reason, box, caption, title};
  views.push(own);
  let from = null;
  box.addEventListener("pointerdown", e => { if (zoom > 1) { from = [e.clientX, e.clientY]; box.setPointerCapture(e.pointerId); } });
  box.addEventListener("pointermove", e => {
    if (!from) return;
    left += (e.clientX - from[0]) / box.clientWidth;
    top_ += (e.clientY - from[1]) / box.clientHeight;
    from = [e.clientX, e.clientY];
    place();
  });
  for (const end of ["pointerup", "pointercancel"]) box.addEventListener(end, () => { from = null; });
  box.addEventListener("dblclick", e => {
    const r = box.getBoundingClientRect();
    zoomBy(2, (e.clientX - r.left) / r.width, (e.clientY - r.top) / r.height);
  });
  box.addEventListener("wheel", e => {
    if (!e.ctrlKey && zoom === 1) return; // the page scrolls
    e.preventDefault();
    const r = box.getBoundingClientRect();
    zoomBy(e.deltaY < 0 ? 1.25 : 0.8, (e.clientX - r.left) / r.width, (e.clientY - r.top) / r.height);
  }, {passive: false});
  return own;
}
function place() {
  left = Math.min(0, Math.max(1 - zoom, left));
  top_ = Math.min(0, Math.max(1 - zoom, top_));
  for (const {canvas, box} of views) {
    canvas.style.transform = `translate(${100 * left}%, ${100 * top_}%) scale(${zoom})`;
    box.classList.toggle("near", zoom >= 2);
    box.style.touchAction = zoom > 1 ? "none" : "pan-y";
  }
}
function zoomBy(factor, x = 0.5, y = 0.5) {
  const next = Math.min(32, Math.max(1, zoom * factor));
  left = x - (x - left) * next / zoom;
  top_ = y - (y - top_) * next / zoom;
  zoom = next;
  place();
}
function whole() { zoom = 1; place(); }

function pixels(image) {
  const canvas = make("canvas", {width: image.width, height: image.height});
  const context = canvas.getContext("2d", {willReadFrequently: true});
  context.drawImage(image, 0, 0);
  return context.getImageData(0, 0, image.width, image.height);
}
function errorMap(truth, image) {
  const a = pixels(truth).data, made = pixels(image), b = made.data, scale = 255 / (3 * +$("scale").value);
  for (let i = 0; i < b.length; i += 4) {
    const sum = Math.abs(a[i] - b[i]) + Math.abs(a[i + 1] - b[i + 1]) + Math.abs(a[i + 2] - b[i + 2]);
    const c = data.colours[Math.min(255, Math.round(sum * scale))];
    b[i] = c[0]; b[i + 1] = c[1]; b[i + 2] = c[2];
  }
  return made;
}
// What a panel shows: a picture (or an error map of it), or why there is none.
async function content(frame, index, errors) {
  const at = frame.p ? frame.p[index] : NONE;
  if (at < 0) return {reason: at === NONE ? "No pictures of this frame in this file." : data.reasons[-1 - at]};
  try {
    const image = await picture(at);
    if (!errors || index === 0) return {image};
    return frame.p[0] < 0 ? {reason: "No error map without ground truth."} : {map: errorMap(await picture(frame.p[0]), image)};
  } catch (error) {
    return {reason: error.message};
  }
}
function paint(own, {image, map, reason}) {
  own.reason.textContent = reason || "";
  own.reason.hidden = !reason;
  const size = image || map;
  if (size) { own.canvas.width = size.width; own.canvas.height = size.height; }
  const context = own.canvas.getContext("2d");
  if (image) context.drawImage(image, 0, 0);
  else if (map) context.putImageData(map, 0, 0);
  else context.clearRect(0, 0, own.canvas.width, own.canvas.height);
  return size;
}
const panels = names.map(name => view($("panels"), name)), pair = view($("pair"), "");
async function show(frame) {
  now = frame;
  if (!frame) return;
  const errors = $("errors").checked, metric = data.metrics[0];
  $("scrub").value = moments.indexOf(frame);
  $("scrub").setAttribute("aria-valuetext", `timestep ${frame.at[4]}`);
  $("moment").textContent = `Timestep ${frame.at[4]}` + (frame.p ? frame.l ? ", lossless" : ", lossy" : "");
  const contents = await Promise.all(names.map((_, index) => content(frame, index, errors)));
  if (now !== frame) return;
  const size = contents.map(c => c.image || c.map).find(Boolean);
  contents.forEach((one, index) => {
    const own = panels[index], value = index && metric ? `${metric.label} ${shown(frame.v[0][index - 1], metric)}` : "";
    if (!(one.image || one.map) && size) { own.canvas.width = size.width; own.canvas.height = size.height; }
    paint(own, one);
    own.caption.replaceChildren(make("b", {textContent: own.title}), value);
    own.canvas.setAttribute("aria-label", `${errors && index ? "Error map of " : ""}${own.title}, timestep ${frame.at[4]}${value && ", " + value}`);
  });
  compare(frame);
  curves();
}
async function compare(frame) {
  if (!$("between").open || !frame) return;
  const [a, b] = await Promise.all([+$("left").value, +$("right").value].map(i => content(frame, i, $("errors").checked)));
  if (now !== frame) return;
  paint(pair, a.reason ? a : b.reason ? b : b);
  if (a.reason || b.reason) return;
  const context = pair.canvas.getContext("2d"), x = Math.round(pair.canvas.width * $("border").value / 100);
  const source = a.image || make("canvas", {width: a.map.width, height: a.map.height});
  if (a.map) source.getContext("2d").putImageData(a.map, 0, 0);
  if (x) context.drawImage(source, 0, 0, x, source.height, 0, 0, x, source.height);
  context.fillStyle = "#d55e00";
  context.fillRect(x, 0, 1, pair.canvas.height);
  const texts = [$("left"), $("right")].map(s => names[+s.value]);
  pair.caption.textContent = `${texts[0]} | ${texts[1]}`;
  pair.canvas.setAttribute("aria-label", `${texts[0]} to the left of the border, ${texts[1]} to the right`);
}

// Drawings: axes with round numbers, labels beside the ends of their lines.
function ticks(low, high, count = 5) {
  const rough = (high - low) / count || 1, power = 10 ** Math.floor(Math.log10(rough));
  const by = [1, 2, 5, 10].find(k => k * power >= rough) * power, found = [];
  for (let i = Math.ceil(low / by); i * by <= high + 1e-9; i++) found.push(+(i * by).toPrecision(10));
  return found;
}
function apart(labels, gap, low, high) {
  labels.sort((a, b) => a.y - b.y);
  labels.forEach((l, i) => { l.at = Math.max(l.y, i ? labels[i - 1].at + gap : low); });
  for (let i = labels.length - 1, limit = high; i >= 0; i--) { labels[i].at = Math.min(labels[i].at, limit); limit = labels[i].at - gap; }
  return labels;
}
function frameOf(W, H, right, ys, yText, xText, label, text = t => t) {
  const box = {l: 56, r: W - right, t: 24, b: H - 40}, svg = draw("svg", {viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": label});
  let low = Math.min(...ys), high = Math.max(...ys);
  const margin = (high - low || Math.abs(high) || 1) * 0.06;
  low -= margin; high += margin;
  const y = v => box.b - (v - low) / (high - low) * (box.b - box.t);
  for (const t of ticks(low, high)) {
    svg.append(draw("line", {class: "grid", x1: box.l, x2: box.r, y1: y(t), y2: y(t)}), draw("text", {x: box.l - 6, y: y(t) + 4, "text-anchor": "end"}, text(t)));
  }
  svg.append(draw("text", {x: 4, y: 14}, yText), draw("text", {x: (box.l + box.r) / 2, y: H - 6, "text-anchor": "middle"}, xText));
  return {svg, box, y};
}
function legendOf(svg, box, labels) {
  for (const l of apart(labels, 15, box.t, box.b)) {
    svg.append(draw("line", {class: "line", x1: box.r + 8, x2: box.r + 26, y1: l.at, y2: l.at, stroke: colour(l.i), "stroke-dasharray": dash(l.i)}), draw("text", {x: box.r + 31, y: l.at + 4}, short(l.name)));
  }
}
let curveKey = "", cursor = null;
function curves() {
  const m = +$("metric").value, metric = data.metrics[m];
  if (!metric || !series.length) return;
  const key = `${m} ${selects.map(s => s.value)}`, ts = series.map(f => f.at[4]);
  const x = (t, box) => box.l + (ts.length > 1 ? (t - ts[0]) / (ts[ts.length - 1] - ts[0]) : 0.5) * (box.r - box.l);
  if (key !== curveKey) {
    curveKey = key;
    const ys = series.flatMap(f => f.v[m]).filter(v => v !== null);
    if (!ys.length) { $("curves").replaceChildren(make("p", {textContent: "No values of this metric here."})); cursor = null; return; }
    const {svg, box, y} = frameOf(960, 320, 190, ys, metric.unit ? `${metric.label} (${metric.unit})` : metric.label, "Timestep", `${metric.label} over timesteps, a line for each method; the values of a frame stand under its pictures`);
    for (const t of ticks(ts[0], ts[ts.length - 1], 10).filter(Number.isInteger)) svg.append(draw("text", {x: x(t, box), y: box.b + 18, "text-anchor": "middle"}, t));
    const labels = [];
    data.methods.forEach((name, i) => {
      const points = series.filter(f => f.v[m][i] !== null).map(f => [x(f.at[4], box), y(f.v[m][i])]);
      if (!points.length) return;
      svg.append(points.length > 1 ? draw("polyline", {class: "line", points: points.join(" "), stroke: colour(i), "stroke-dasharray": dash(i)}) : draw("circle", {cx: points[0][0], cy: points[0][1], r: 4, fill: colour(i)}));
      labels.push({y: points[points.length - 1][1], name, i});
    });
    legendOf(svg, box, labels);
    cursor = draw("line", {class: "now", y1: box.t, y2: box.b});
    const hit = draw("rect", {class: "hit", x: box.l, y: box.t, width: box.r - box.l, height: box.b - box.t});
    hit.addEventListener("click", e => {
      const r = hit.getBoundingClientRect();
      show(nearest(ts[0] + (e.clientX - r.left) / r.width * (ts[ts.length - 1] - ts[0])));
    });
    svg.append(cursor, hit);
    $("curves").replaceChildren(svg);
    cursor.box = box;
  }
  if (cursor && now) for (const end of ["x1", "x2"]) cursor.setAttribute(end, x(now.at[4], cursor.box));
}
for (const plot of data.plots) {
  const xs = plot.points.map(p => Math.log10(p[1])), low = Math.min(...xs), high = Math.max(...xs);
  const {svg, box, y} = frameOf(520, 320, 20, plot.points.map(p => p[2]), plot.y, plot.x, `${plot.title}: ${plot.points.map(p => `${p[0]} ${p[2].toPrecision(4)} at ${p[1].toPrecision(3)}`).join("; ")}`);
  const x = v => box.l + 30 + (high > low ? (Math.log10(v) - low) / (high - low) : 0.5) * (box.r - box.l - 120);
  for (let e = Math.floor(low); e <= high + 1; e++) for (const k of [1, 2, 5]) {
    const t = k * 10 ** e;
    if (x(t) >= box.l && x(t) <= box.r) svg.append(draw("text", {x: x(t), y: box.b + 18, "text-anchor": "middle"}, +t.toPrecision(3)));
  }
  svg.append(draw("polyline", {class: "front", points: plot.front.map(i => [x(plot.points[i][1]), y(plot.points[i][2])]).join(" ")}));
  const labels = plot.points.map((p, i) => ({y: y(p[2]), x: x(p[1]), name: p[0], i}));
  for (const l of labels) svg.append(draw("circle", {cx: l.x, cy: l.y, r: 5, fill: colour(data.methods.indexOf(l.name))}));
  for (const l of labels) {
    const crossed = labels.some(o => o !== l && Math.abs(o.y - l.y) < 15 && o.x > l.x && o.x - l.x < 110);
    svg.append(draw("text", {x: l.x + (crossed ? -9 : 9), y: l.y - 7, "text-anchor": crossed ? "end" : "start"}, short(l.name)));
  }
  $("plots").append(make("div", {}, make("h3", {textContent: plot.title}), svg));
}
if (!data.plots.length) $("front").hidden = true;
if (data.training.length) {
  const points = data.training.flatMap(c => c.points), end = Math.max(...points.map(p => p[0]));
  const {svg, box, y} = frameOf(960, 320, 190, points.map(p => Math.log10(p[1])), "Loss, first = 1", "Iteration",
    `Training loss over iterations, divided by the first one: ${data.training.map(c => `${data.methods[c.method]} ends at ${c.points.at(-1)[1]}`).join("; ")}`, t => +(10 ** t).toPrecision(2));
  const x = t => box.l + t / end * (box.r - box.l), labels = [];
  for (const t of ticks(0, end, 8)) svg.append(draw("text", {x: x(t), y: box.b + 18, "text-anchor": "middle"}, t));
  for (const {method, points} of data.training) {
    svg.append(draw("polyline", {class: "line", points: points.map(p => [x(p[0]), y(Math.log10(p[1]))]).join(" "), stroke: colour(method), "stroke-dasharray": dash(method)}));
    labels.push({y: y(Math.log10(points.at(-1)[1])), name: data.methods[method], i: method});
  }
  legendOf(svg, box, labels);
  $("losses").append(svg);
} else $("training").hidden = true;

// Places worth a look: one frame for each timestep of a subject and sequence.
function list(target, score, text) {
  const seen = new Map(), task = +selects[0].value;
  for (const f of frames) {
    const value = f.at[0] === task ? score(f) : null, moment = [f.at[1], f.at[2], f.at[4]].join();
    if (value !== null && !(seen.has(moment) && seen.get(moment)[0] >= value)) seen.set(moment, [value, f]);
  }
  const best = [...seen.values()].sort((a, b) => b[0] - a[0]).slice(0, 8);
  target.replaceChildren(...best.map(([, f]) => {
    const where = `${data.subjects[f.at[1]]} ${data.sequences[f.at[2]]} timestep ${f.at[4]}, camera ${data.cameras[f.at[3]]}`;
    const button = make("button", {type: "button", disabled: !f.p, textContent: `${text(f)}: ${where}${f.p ? "" : " (no pictures)"}`});
    button.addEventListener("click", () => go(f));
    return make("li", {}, button);
  }));
}
function places() {
  const m = +$("metric").value, metric = data.metrics[m];
  if (!metric) return;
  const i = +$("worst-method").value, a = +$("first").value, b = +$("second").value, sign = metric.up ? -1 : 1;
  list($("worst"), f => f.v[m][i] === null ? null : sign * f.v[m][i], f => `${metric.label} ${shown(f.v[m][i], metric)}`);
  list($("apart"), f => f.v[m][a] === null || f.v[m][b] === null || a === b ? null : Math.abs(f.v[m][a] - f.v[m][b]),
    f => `${metric.label} ${shown(f.v[m][a], metric)} and ${shown(f.v[m][b], metric)}`);
}

// Controls.
const valued = numbered(data.methods).filter(([index]) => frames.some(f => f.v.length && f.v[0][index] !== null));
const scored = valued.filter(([, name]) => !trivial(name)), offered = scored.length ? scored : valued;
options($("scale"), [10, 20, 50, 100, 255].map(v => [v, v]), 50);
options($("left"), numbered(names), 0);
options($("right"), numbered(names), offered.length ? offered[offered.length - 1][0] + 1 : 0);
options($("metric"), numbered(data.metrics.map(m => m.label)));
for (const id of ["worst-method", "first", "second"]) options($(id), valued);
$("worst-method").value = $("second").value = offered.length ? offered[offered.length - 1][0] : 0;
$("first").value = offered.length ? offered[0][0] : 0;
const legend = $("legend").getContext("2d");
data.colours.forEach((c, i) => { legend.fillStyle = `rgb(${c})`; legend.fillRect(i, 0, 1, 10); });
function play() {
  if (timer) clearInterval(timer);
  timer = timer ? 0 : setInterval(() => step(1), 160);
  $("play").textContent = timer ? "Pause" : "Play";
  $("play").setAttribute("aria-pressed", Boolean(timer));
}
const again = () => show(now);
function toggle() { $("errors").checked = !$("errors").checked; again(); $("status").textContent = $("errors").checked ? "Error maps" : "Renders"; }
$("scrub").addEventListener("input", () => show(moments[+$("scrub").value]));
$("play").addEventListener("click", play);
for (const id of ["errors", "scale"]) $(id).addEventListener("change", again);
for (const id of ["left", "right"]) $(id).addEventListener("change", () => compare(now));
$("border").addEventListener("input", () => compare(now));
$("between").addEventListener("toggle", () => compare(now));
$("metric").addEventListener("change", () => { curves(); places(); });
for (const id of ["worst-method", "first", "second"]) $(id).addEventListener("change", places);
selects[0].addEventListener("change", places);
$("closer").addEventListener("click", () => zoomBy(1.5));
$("further").addEventListener("click", () => zoomBy(1 / 1.5));
$("whole").addEventListener("click", whole);
document.addEventListener("keydown", e => {
  if (e.ctrlKey || e.metaKey || e.altKey || e.target.matches("select, input, textarea, pre, .wide")) {
    if (!(e.target.matches("input[type=checkbox], input[type=range]") && "e+-0".includes(e.key)) || e.ctrlKey || e.metaKey || e.altKey) return;
  }
  if (e.key === " " && e.target.matches("button, summary")) return;
  const keys = {ArrowLeft: () => step(-1), ArrowRight: () => step(1), " ": play, e: toggle, "+": () => zoomBy(1.5), "-": () => zoomBy(1 / 1.5), 0: whole};
  if (keys[e.key]) { keys[e.key](); e.preventDefault(); }
});
if (frames.length) { choose(0); places(); } else $("viewer").hidden = true;
