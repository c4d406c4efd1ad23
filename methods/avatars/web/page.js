"use strict";
// Draws an avatar of 3D Gaussians with sliders. The layout of the bytes and the arithmetic are those of payload.py and model.py.
const HEIGHT_FIELD = 30 * Math.PI / 180, LOW_PASS = 0.3, ALPHA_MIN = 1 / 255, ALPHA_MAX = 0.99, TEXELS = 4, MARGIN = 0.3, FRAMES_PER_SECOND = 25;
const at = id => document.getElementById(id);

async function read() {
  const text = atob(at("avatar").textContent.trim()), packed = Uint8Array.from(text, c => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate-raw"));
  const whole = new Uint8Array(await new Response(stream).arrayBuffer());
  const length = new DataView(whole.buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(whole.subarray(4, 4 + length)));
  const arrays = {}, n = header.count;
  let place = 4 + length;
  for (const array of header.arrays) {
    const columns = array.low.length, values = new Float32Array(n * columns);
    for (let c = 0; c < columns; c++) {
      for (let i = 0; i < n; i++) {
        const level = whole[place + i] + (array.bits === 16 ? 256 * whole[place + n + i] : 0);
        values[i * columns + c] = array.low[c] + array.step[c] * level;
      }
      place += n * array.bits / 8;
    }
    arrays[array.name] = values;
  }
  return {header, arrays, n};
}

function rotation(x, y, z) { // of a rotation vector, row by row
  const angle = Math.hypot(x, y, z), s = angle > 1e-9 ? Math.sin(angle) / angle : 1, k = angle > 1e-9 ? (1 - Math.cos(angle)) / (angle * angle) : 0.5;
  const c = Math.cos(angle);
  return [c + k * x * x, k * x * y - s * z, k * x * z + s * y, k * x * y + s * z, c + k * y * y, k * y * z - s * x,
          k * x * z - s * y, k * y * z + s * x, c + k * z * z];
}
const product = (a, b) => Array.from({length: 9}, (_, i) => {
  const r = 3 * Math.floor(i / 3), c = i % 3;
  return a[r] * b[c] + a[r + 1] * b[3 + c] + a[r + 2] * b[6 + c];
});
const apply = (a, p) => [0, 3, 6].map(r => a[r] * p[0] + a[r + 1] * p[1] + a[r + 2] * p[2]);

function motions({sliders, joints}, values) {
  const turns = joints.map(() => [0, 0, 0]);
  sliders.forEach((slider, i) => slider.joints.forEach(j => { turns[j][slider.axis] += values[i]; }));
  const found = joints.map((joint, j) => {
    const linear = rotation(...turns[j]), moved = apply(linear, joint);
    return {linear, shift: joint.map((v, k) => v - moved[k])};
  });
  for (let j = 1; j < found.length; j++) {
    const moved = apply(found[0].linear, found[j].shift);
    found[j] = {linear: product(found[0].linear, found[j].linear), shift: moved.map((v, k) => v + found[0].shift[k])};
  }
  return found;
}

// Splats of a pose: means, inverse turns for colours, axes times scales, opacities, changes of colour.
function pose(data, values) {
  const {header, arrays, n} = data, steps = header.sliders.map((s, i) => values[i] / s.step);
  const used = steps.map((step, i) => [step, i]).filter(([step]) => step !== 0);
  const {means, quats, log_scales, logits, weights} = arrays, joints = motions(header, values);
  const out = data.posed ||= {means: new Float32Array(3 * n), linear: new Float32Array(9 * n), axes: new Float32Array(9 * n),
                              alpha: new Float32Array(n), added: new Float32Array(3 * n)};
  const morphs = used.map(([step, i]) => ({step, m: arrays[`d_means ${i}`], t: arrays[`d_turns ${i}`], s: arrays[`d_log_scales ${i}`],
                                           o: arrays[`d_logits ${i}`], c: arrays[`d_colors ${i}`]}));
  const A = new Float64Array(9), b = new Float64Array(3);
  for (let i = 0; i < n; i++) {
    const j3 = 3 * i;
    let x = means[j3], y = means[j3 + 1], z = means[j3 + 2], tx = 0, ty = 0, tz = 0, o = logits[i];
    let s0 = log_scales[j3], s1 = log_scales[j3 + 1], s2 = log_scales[j3 + 2], r = 0, g = 0, blue = 0;
    for (let k = 0; k < morphs.length; k++) {
      const {step, m, t, s, o: d, c} = morphs[k];
      x += step * m[j3]; y += step * m[j3 + 1]; z += step * m[j3 + 2];
      tx += step * t[j3]; ty += step * t[j3 + 1]; tz += step * t[j3 + 2];
      s0 += step * s[j3]; s1 += step * s[j3 + 1]; s2 += step * s[j3 + 2];
      r += step * c[j3]; g += step * c[j3 + 1]; blue += step * c[j3 + 2]; o += step * d[i];
    }
    let rest = 1;
    A.fill(0); b.fill(0);
    for (let k = 0; k < 4; k++) {
      const w = weights[4 * i + k];
      if (!w) continue;
      const {linear, shift} = joints[k];
      rest -= w;
      for (let e = 0; e < 9; e++) A[e] += w * linear[e];
      for (let e = 0; e < 3; e++) b[e] += w * shift[e];
    }
    A[0] += rest; A[4] += rest; A[8] += rest;
    out.means[j3] = A[0] * x + A[1] * y + A[2] * z + b[0];
    out.means[j3 + 1] = A[3] * x + A[4] * y + A[5] * z + b[1];
    out.means[j3 + 2] = A[6] * x + A[7] * y + A[8] * z + b[2];
    const q = 4 * i;
    let w = quats[q], p = quats[q + 1], u = quats[q + 2], v = quats[q + 3];
    const angle = Math.sqrt(tx * tx + ty * ty + tz * tz);
    if (angle > 1e-9) { // turned by a rotation vector: a product of quaternions
      const c = Math.cos(angle / 2), s = Math.sin(angle / 2) / angle, X = s * tx, Y = s * ty, Z = s * tz;
      [w, p, u, v] = [c * w - X * p - Y * u - Z * v, c * p + X * w + Y * v - Z * u, c * u - X * v + Y * w + Z * p, c * v + X * u - Y * p + Z * w];
    }
    const norm = 2 / (w * w + p * p + u * u + v * v || 1), at9 = 9 * i;
    const r0 = 1 - norm * (u * u + v * v), r1 = norm * (p * u - w * v), r2 = norm * (p * v + w * u);
    const r3 = norm * (p * u + w * v), r4 = 1 - norm * (p * p + v * v), r5 = norm * (u * v - w * p);
    const r6 = norm * (p * v - w * u), r7 = norm * (u * v + w * p), r8 = 1 - norm * (p * p + u * u);
    const e0 = Math.exp(s0), e1 = Math.exp(s1), e2 = Math.exp(s2);
    for (let row = 0; row < 9; row += 3) {
      const a = A[row], c = A[row + 1], d = A[row + 2];
      out.axes[at9 + row] = e0 * (a * r0 + c * r3 + d * r6);
      out.axes[at9 + row + 1] = e1 * (a * r1 + c * r4 + d * r7);
      out.axes[at9 + row + 2] = e2 * (a * r2 + c * r5 + d * r8);
    }
    for (let e = 0; e < 9; e++) out.linear[at9 + e] = A[e];
    out.alpha[i] = 1 / (1 + Math.exp(-o));
    out.added[j3] = 0.5 + r; out.added[j3 + 1] = 0.5 + g; out.added[j3 + 2] = 0.5 + blue;
  }
  return out;
}

// Real spherical harmonics up to degree 3 in the order and with the signs of 3DGS.
function basis(x, y, z, out) {
  const xx = x * x, yy = y * y, zz = z * z;
  out[0] = 0.28209479177387814;
  out[1] = -0.4886025119029199 * y; out[2] = 0.4886025119029199 * z; out[3] = -0.4886025119029199 * x;
  out[4] = 1.0925484305920792 * x * y; out[5] = -1.0925484305920792 * y * z; out[6] = 0.31539156525252005 * (2 * zz - xx - yy);
  out[7] = -1.0925484305920792 * x * z; out[8] = 0.5462742152960396 * (xx - yy);
  out[9] = -0.5900435899266435 * y * (3 * xx - yy); out[10] = 2.890611442640554 * x * y * z;
  out[11] = -0.4570457994644658 * y * (4 * zz - xx - yy); out[12] = 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy);
  out[13] = -0.4570457994644658 * x * (4 * zz - xx - yy); out[14] = 1.445305721320277 * z * (xx - yy);
  out[15] = -0.5900435899266435 * x * (xx - 3 * yy);
}

// Means, covariances, colours and opacities as the texture has them, seen from a point.
function texels(data, center) {
  const {header, arrays, n, posed} = data, K = arrays.harmonics.length / n / 3, harmonics = arrays.harmonics, Y = new Float64Array(16);
  const out = data.texels ||= new Float32Array(data.width * data.rows * 4);
  for (let i = 0; i < n; i++) {
    const j3 = 3 * i, j9 = 9 * i, to = 4 * TEXELS * i, m = posed.axes, A = posed.linear;
    const x = posed.means[j3], y = posed.means[j3 + 1], z = posed.means[j3 + 2];
    out[to] = x; out[to + 1] = y; out[to + 2] = z; out[to + 3] = posed.alpha[i];
    for (let row = 0, e = 4; row < 3; row++) for (let c = row; c < 3; c++, e++) // xx xy xz yy yz zz
      out[to + e] = m[j9 + 3 * row] * m[j9 + 3 * c] + m[j9 + 3 * row + 1] * m[j9 + 3 * c + 1] + m[j9 + 3 * row + 2] * m[j9 + 3 * c + 2];
    let dx = x - center[0], dy = y - center[1], dz = z - center[2];
    if (header.turned) [dx, dy, dz] = [A[j9] * dx + A[j9 + 3] * dy + A[j9 + 6] * dz, A[j9 + 1] * dx + A[j9 + 4] * dy + A[j9 + 7] * dz,
                                       A[j9 + 2] * dx + A[j9 + 5] * dy + A[j9 + 8] * dz];
    const norm = Math.hypot(dx, dy, dz);
    basis(dx / norm, dy / norm, dz / norm, Y);
    let r = posed.added[j3], g = posed.added[j3 + 1], b = posed.added[j3 + 2];
    for (let k = 0, h = 3 * K * i; k < K; k++, h += 3) { r += harmonics[h] * Y[k]; g += harmonics[h + 1] * Y[k]; b += harmonics[h + 2] * Y[k]; }
    out[to + 12] = Math.max(r, 0); out[to + 13] = Math.max(g, 0); out[to + 14] = Math.max(b, 0);
  }
  return out;
}

// Indices from the farthest to the nearest, by counting depths in 2^16 classes.
function order(data, ahead, center) {
  const {n, posed: {means}} = data, keys = data.keys ||= new Uint16Array(n), indices = data.indices ||= new Uint32Array(n);
  const depths = data.depths ||= new Float32Array(n), counts = data.counts ||= new Uint32Array(65537);
  let low = Infinity, high = -Infinity;
  for (let i = 0; i < n; i++) {
    const d = ahead[0] * (means[3 * i] - center[0]) + ahead[1] * (means[3 * i + 1] - center[1]) + ahead[2] * (means[3 * i + 2] - center[2]);
    depths[i] = d; if (d < low) low = d; if (d > high) high = d;
  }
  counts.fill(0);
  const scale = 65535 / Math.max(high - low, 1e-9);
  for (let i = 0; i < n; i++) { keys[i] = (high - depths[i]) * scale; counts[keys[i] + 1]++; }
  for (let k = 0; k < 65536; k++) counts[k + 1] += counts[k];
  for (let i = 0; i < n; i++) indices[counts[keys[i]]++] = i;
  return indices;
}

const VERTEX = `#version 300 es
precision highp float; precision highp sampler2D;
uniform sampler2D splats; uniform int perRow; uniform mat3 turn; uniform vec3 center; uniform vec2 size; uniform float focal, pixel;
layout(location = 0) in vec2 corner; layout(location = 1) in uint index;
out vec2 offset; flat out vec3 conic; flat out vec4 color;
vec4 texel(int k) { int i = int(index); return texelFetch(splats, ivec2(${TEXELS} * (i % perRow) + k, i / perRow), 0); }
void main() {
  vec4 a = texel(0), b = texel(1), c = texel(2), d = texel(3);
  vec3 p = turn * (a.xyz - center);
  gl_Position = vec4(0, 0, 2, 1);
  if (p.z < 0.01 || a.w < ${ALPHA_MIN}) return;
  vec2 limit = ${1 + MARGIN} * 0.5 * size / focal, slope = clamp(p.xy / p.z, -limit, limit);
  mat3 S = mat3(b.x, b.y, b.z, b.y, b.w, c.x, b.z, c.x, c.y);
  mat3 V = turn * S * transpose(turn);
  vec3 jx = vec3(1, 0, -slope.x) * focal / p.z, jy = vec3(0, 1, -slope.y) * focal / p.z;
  float enlarged = max(1.0, pixel * focal / p.z), low = ${LOW_PASS} * enlarged * enlarged;
  float xx = dot(jx, V * jx) + low, xy = dot(jx, V * jy), yy = dot(jy, V * jy) + low;
  float det = xx * yy - xy * xy;
  if (!(det > 0.0)) return;
  conic = vec3(yy, -xy, xx) / det; color = vec4(d.rgb, a.w);
  vec2 reach = sqrt(2.0 * log(a.w / ${ALPHA_MIN}) * vec2(xx, yy)) + 1.0;
  offset = corner * reach;
  vec2 pixel = focal * p.xy / p.z + 0.5 * size + offset;
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0, 1);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec2 offset; flat in vec3 conic; flat in vec4 color; out vec4 drawn;
void main() {
  float alpha = min(${ALPHA_MAX}, color.a * exp(-0.5 * (conic.x * offset.x * offset.x + 2.0 * conic.y * offset.x * offset.y + conic.z * offset.y * offset.y)));
  if (alpha < ${ALPHA_MIN}) discard;
  drawn = vec4(color.rgb * alpha, alpha);
}`;
const COPY = [`#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0, 1); }`, `#version 300 es
precision highp float; uniform sampler2D image; uniform vec3 ground; out vec4 drawn;
void main() { vec4 v = texelFetch(image, ivec2(gl_FragCoord.xy), 0); drawn = vec4(v.rgb + (1.0 - v.a) * ground, 1); }`];

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source); gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  return {made, at: name => gl.getUniformLocation(made, name)};
}

function renderer(canvas, data) {
  const gl = canvas.getContext("webgl2", {alpha: false, antialias: false, preserveDrawingBuffer: true});
  if (!gl) throw new Error("This browser has no WebGL2.");
  // Half floats where they can be blended: hundreds of layers would each be rounded to 8 bits.
  const half = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
  const splat = program(gl, VERTEX, FRAGMENT), copy = program(gl, ...COPY);
  data.perRow = Math.floor(2048 / TEXELS); data.width = TEXELS * data.perRow; data.rows = Math.ceil(data.n / data.perRow);
  const texture = () => { const t = gl.createTexture(); gl.bindTexture(gl.TEXTURE_2D, t);
    for (const name of ["MIN", "MAG"]) gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${name}_FILTER`], gl.NEAREST); return t; };
  const values = texture(), target = texture(), frame = gl.createFramebuffer(), shape = gl.createVertexArray(), empty = gl.createVertexArray();
  gl.bindVertexArray(shape);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0); gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
  const indices = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, indices);
  gl.enableVertexAttribArray(1); gl.vertexAttribIPointer(1, 1, gl.UNSIGNED_INT, 0, 0); gl.vertexAttribDivisor(1, 1);
  let width = 0, height = 0;
  return (camera, ground, pixel) => {
    if (width !== canvas.width || height !== canvas.height) {
      [width, height] = [canvas.width, canvas.height];
      gl.bindTexture(gl.TEXTURE_2D, target);
      gl.texImage2D(gl.TEXTURE_2D, 0, half ? gl.RGBA16F : gl.RGBA8, width, height, 0, gl.RGBA, half ? gl.HALF_FLOAT : gl.UNSIGNED_BYTE, null);
      gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target, 0);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame); gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0); gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(splat.made); gl.bindVertexArray(shape);
    gl.activeTexture(gl.TEXTURE0); gl.bindTexture(gl.TEXTURE_2D, values);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, data.width, data.rows, 0, gl.RGBA, gl.FLOAT, texels(data, camera.center));
    gl.bindBuffer(gl.ARRAY_BUFFER, indices);
    gl.bufferData(gl.ARRAY_BUFFER, order(data, camera.turn.slice(6, 9), camera.center), gl.DYNAMIC_DRAW);
    gl.uniform1i(splat.at("splats"), 0); gl.uniform1i(splat.at("perRow"), data.perRow);
    gl.uniformMatrix3fv(splat.at("turn"), true, camera.turn); gl.uniform3fv(splat.at("center"), camera.center);
    gl.uniform2f(splat.at("size"), width, height);
    gl.uniform1f(splat.at("focal"), focal(width, height)); gl.uniform1f(splat.at("pixel"), pixel);
    gl.enable(gl.BLEND); gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, data.n);
    gl.disable(gl.BLEND); gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.useProgram(copy.made); gl.bindVertexArray(empty); gl.bindTexture(gl.TEXTURE_2D, target);
    gl.uniform1i(copy.at("image"), 0); gl.uniform3fv(copy.at("ground"), ground);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  };
}

const focal = (width, height) => Math.min(width, height) / 2 / Math.tan(HEIGHT_FIELD / 2);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
function view({azimuth, elevation, distance, target}) {
  const ahead = [-Math.sin(azimuth) * Math.cos(elevation), -Math.sin(elevation), -Math.cos(azimuth) * Math.cos(elevation)];
  const side = cross(ahead, [0, 1, 0]), norm = Math.hypot(...side), right = side.map(v => v / norm);
  return {turn: [...right, ...cross(ahead, right), ...ahead], center: target.map((v, i) => v - distance * ahead[i])};
}

// Sliders by the first word of joints' names; expressions have no joint.
const groupOf = slider => slider.joints.length ? slider.name.split(" ")[0] : "expressions";
function made(tag, attributes, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

async function main() {
  const data = await read(), {sliders, view: first, pictures, sequences, trained} = data.header;
  const canvas = at("view"), draw = renderer(canvas, data), dark = matchMedia("(prefers-color-scheme: dark)");
  const start = {azimuth: 0, elevation: 0, ...first}, state = {camera: {...start}, values: sliders.map(() => 0), playing: false, moment: 0};
  let posed = false, waiting = false, told = "";
  const ground = () => {
    const [, hex] = /^#(.*)/.exec(at("ground").value) || [], rgb = getComputedStyle(document.body).backgroundColor.match(/[\d.]+/g);
    return hex ? [0, 2, 4].map(i => parseInt(hex.slice(i, i + 2), 16) / 255) : rgb.slice(0, 3).map(v => v / 255);
  };
  const show = () => {
    waiting = false;
    const begun = performance.now(), box = canvas.getBoundingClientRect(), ratio = state.exact ? 1 : Math.min(devicePixelRatio, 2);
    canvas.width = Math.max(1, Math.round(box.width * ratio)); canvas.height = Math.max(1, Math.round(box.height * ratio));
    if (!posed) pose(data, state.values);
    posed = true;
    const pixel = trained && !state.sharp ? trained.pixel : 0;
    draw(view(state.camera), state.exact ? [1, 1, 1] : ground(), pixel);
    const took = `${data.n.toLocaleString("en")} splats, ${(performance.now() - begun).toFixed(0)} ms of script`;
    // A status that changes with every frame would be read aloud with every frame.
    if (!told || !state.playing) at("time").textContent = told = took;
    if (trained) {
      const times = trained.pixel * focal(canvas.width, canvas.height) / state.camera.distance;
      at("size").textContent = `Trained on images of ${trained.size.join(" × ")} pixels` +
        (times > 1 ? `, shown enlarged ${times.toFixed(1)} times and therefore smoothed to their resolution.` : ".");
    }
    state.drawn = (state.drawn || 0) + 1;
  };
  const ask = () => { if (!waiting) { waiting = true; requestAnimationFrame(show); } };
  const inputs = [], faces = [];
  const moved = () => {
    inputs.forEach((input, i) => { if (input) { input.value = state.values[i]; faces[i]?.setAttribute("aria-pressed", state.values[i] >= 0.99 * sliders[i].high); } });
    posed = false; ask();
  };
  const stop = () => { state.playing = false; at("play").textContent = "Play"; };
  const groups = {};
  sliders.forEach((slider, i) => {
    if (!slider.name) return;
    const group = groupOf(slider), title = group[0].toUpperCase() + group.slice(1), id = `slider-${i}`;
    groups[group] ||= made("section", {"aria-labelledby": `group-${group}`}, made("h2", {id: `group-${group}`}, title));
    const name = slider.joints.length ? slider.name.slice(group.length + 1) : slider.name;
    const input = inputs[i] = made("input", {id, type: "range", min: slider.low, max: slider.high, step: (slider.high - slider.low) / 200,
                                             value: 0, "aria-label": slider.name});
    const row = made("div", {class: "row"}, made("label", {for: id}, name), input);
    input.addEventListener("input", () => { stop(); state.values[i] = +input.value; moved(); });
    if (pictures[i]) {
      const face = faces[i] = made("button", {class: "face", type: "button", "aria-label": `${slider.name} at its end`, "aria-pressed": false},
                                   made("img", {src: pictures[i], alt: ""}));
      face.addEventListener("click", () => {
        const value = face.getAttribute("aria-pressed") === "true" ? 0 : slider.high;
        stop(); sliders.forEach((other, k) => { if (!other.joints.length) state.values[k] = 0; }); state.values[i] = value; moved();
      });
      row.prepend(face);
    }
    groups[group].append(row);
  });
  at("groups").append(...Object.values(groups));

  const chosen = () => sequences[at("sequence").value];
  const seek = moment => {
    state.moment = moment; at("moment").value = moment;
    state.values = chosen().values[moment].map((value, i) => value * sliders[i].step); moved();
  };
  const choose = () => { at("moment").max = chosen().values.length - 1; at("moment").disabled = at("play").disabled = chosen().values.length < 2; };
  if (sequences.length) {
    at("recorded").hidden = false;
    at("sequence").append(...sequences.map(({name, note}, i) => made("option", {value: i}, note ? `${name}, ${note}` : name)));
    choose();
    at("sequence").addEventListener("change", () => { choose(); seek(0); });
    at("moment").addEventListener("input", () => { stop(); seek(+at("moment").value); });
    at("play").addEventListener("click", () => {
      if (state.playing) return stop();
      state.playing = true; at("play").textContent = "Pause";
      const begun = performance.now(), from = state.moment;
      const next = now => {
        if (!state.playing) return;
        const moment = (from + Math.floor(Math.max(0, now - begun) * FRAMES_PER_SECOND / 1000)) % chosen().values.length;
        if (moment !== state.moment) seek(moment);
        requestAnimationFrame(next);
      };
      requestAnimationFrame(next);
    });
  }
  at("reset").addEventListener("click", () => { stop(); state.values.fill(0); state.camera = {...start}; state.moment = 0; at("moment").value = 0; moved(); });
  at("ground").addEventListener("change", ask);
  dark.addEventListener("change", ask);
  const turn = (dx, dy) => {
    state.camera.azimuth -= 0.006 * dx;
    state.camera.elevation = Math.max(-1.4, Math.min(1.4, state.camera.elevation + 0.006 * dy)); ask();
  };
  const zoom = factor => { state.camera.distance = Math.max(0.2, Math.min(5, state.camera.distance * factor)); ask(); };
  const fingers = new Map();
  canvas.addEventListener("pointerdown", e => { canvas.setPointerCapture(e.pointerId); fingers.set(e.pointerId, [e.clientX, e.clientY]); });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, e => fingers.delete(e.pointerId));
  canvas.addEventListener("pointermove", e => {
    const before = fingers.get(e.pointerId), others = [...fingers].filter(([id]) => id !== e.pointerId);
    if (!before) return;
    if (others.length) {
      const [x, y] = others[0][1];
      zoom(Math.hypot(before[0] - x, before[1] - y) / Math.max(1, Math.hypot(e.clientX - x, e.clientY - y)));
    } else turn(e.clientX - before[0], e.clientY - before[1]);
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
  });
  canvas.addEventListener("wheel", e => { e.preventDefault(); zoom(Math.exp(0.001 * e.deltaY)); }, {passive: false});
  canvas.addEventListener("keydown", e => {
    const keys = {ArrowLeft: () => turn(-20, 0), ArrowRight: () => turn(20, 0), ArrowUp: () => turn(0, -20), ArrowDown: () => turn(0, 20),
                  "+": () => zoom(0.9), "-": () => zoom(1.1)};
    if (keys[e.key]) { e.preventDefault(); keys[e.key](); }
  });
  addEventListener("resize", ask);
  show();
  window.avatar = {state, show: () => { posed = false; show(); }};
}
main().catch(error => { at("time").textContent = `Cannot be shown: ${error.message}`; });
