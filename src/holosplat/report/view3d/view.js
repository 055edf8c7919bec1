// Phase shift and hologram of the objects of a report from any side (docs/run_files.md has the layout of the data).
// Line integrals are added up in WebGL2, in 32-bit floats; waves are computed here, by Fourier transforms.
"use strict";
(async () => {
const root = document.currentScript.closest(".view3d");
const pick = (name) => root.querySelector(`[name="${name}"]`);
const facts = JSON.parse(root.querySelector(".header").textContent);
const { rows, columns } = facts;

// --- data ------------------------------------------------------------------------------------------------------

const TYPES = { uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array, int16: Int16Array, float16: Uint16Array,
  float32: Float32Array };

async function unpacked(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

function arraysOf(part, buffer) {
  const found = {};
  for (const [name, { type, shape, at }] of Object.entries(part.arrays)) {
    const count = shape.reduce((a, b) => a * b, 1);
    found[name] = { type, shape, values: new TYPES[type](buffer, at, count) };
  }
  return found;
}

// --- line integrals in WebGL2 ----------------------------------------------------------------------------------

const HEAD = `#version 300 es
precision highp float; precision highp sampler3D;
uniform mat3 R; uniform vec2 frame, shift; uniform float low, step_, weight;
vec4 placed(vec2 p) { return vec4(2.0 * (p - shift) / frame, 0.0, 1.0); }
`;
const SOURCES = {
  // Each Gaussian is a square that holds four standard deviations; a pixel's own variance, 1/12, stands for its area.
  gaussians: [`${HEAD}
in vec3 centre, scale; in vec4 quaternion; in vec2 amplitude;
out vec2 at; flat out vec3 inverse; flat out vec2 peak;
void main() {
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  vec4 q = normalize(quaternion); float w = q.x; vec3 v = q.yzw;
  mat3 Q = mat3(1.0) + 2.0 * mat3(
    -v.y*v.y - v.z*v.z, v.x*v.y + w*v.z, v.x*v.z - w*v.y,
    v.x*v.y - w*v.z, -v.x*v.x - v.z*v.z, v.y*v.z + w*v.x,
    v.x*v.z + w*v.y, v.y*v.z - w*v.x, -v.x*v.x - v.y*v.y);
  mat3 L = R * Q * mat3(scale.x, 0, 0, 0, scale.y, 0, 0, 0, scale.z);
  mat3 C = L * transpose(L);
  float a = C[0][0] + 1.0 / 12.0, b = C[0][1], c = C[1][1] + 1.0 / 12.0, det = a * c - b * b;
  inverse = vec3(c, -b, a) / det;
  peak = amplitude * scale.x * scale.y * scale.z * sqrt(6.283185307179586 / det);
  at = corner * 4.0 * sqrt(vec2(a, c));
  gl_Position = placed((R * (low + step_ * centre)).xy + at);
}`, `${HEAD}
in vec2 at; flat in vec3 inverse; flat in vec2 peak; out vec4 sum;
void main() {
  float d = inverse.x * at.x * at.x + 2.0 * inverse.y * at.x * at.y + inverse.z * at.y * at.y;
  sum = vec4(d > 16.0 ? vec2(0.0) : peak * exp(-0.5 * d), 0.0, 0.0);
}`],
  // Where a ray leaves the body its depth counts, where it enters its depth is taken away.
  surfaces: [`${HEAD}
in vec3 vertex; out float depth;
void main() { vec3 p = R * vertex; depth = p.z; gl_Position = placed(p.xy); }`, `${HEAD}
in float depth; out vec4 sum;
void main() { sum = vec4(weight * (gl_FrontFacing ? depth : -depth), 0.0, 0.0, 0.0); }`],
  // Samples half a voxel apart along each ray, linear between voxels.
  volume: [`${HEAD}
out vec2 at;
void main() {
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  at = 0.5 * frame * corner + shift; gl_Position = vec4(corner, 0.0, 1.0);
}`, `${HEAD}
uniform sampler3D first, second; uniform vec3 voxel, middle, counts; uniform vec2 lows, steps;
in vec2 at; out vec4 sum;
void main() {
  vec3 half_ = 0.5 * voxel * counts; float reach = length(half_), stride = 0.5 * min(voxel.x, min(voxel.y, voxel.z));
  vec3 from = (vec3(at, 0.0)) * R - middle, along = vec3(0.0, 0.0, 1.0) * R;
  float centre = -dot(from, along); vec2 total = vec2(0.0);
  int n = int(ceil(reach / stride));
  for (int i = -n; i <= n; i++) {
    vec3 p = (from + (centre + float(i) * stride) * along) / (voxel * counts) + 0.5;
    if (all(greaterThanEqual(p, vec3(0.0))) && all(lessThanEqual(p, vec3(1.0))))
      total += lows + 255.0 * steps * vec2(texture(first, p).r, texture(second, p).r);
  }
  sum = vec4(stride * total, 0.0, 0.0);
}`],
};

function contextOf() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) throw new Error("this browser has no WebGL2");
  for (const name of ["EXT_color_buffer_float", "EXT_float_blend"])
    if (!gl.getExtension(name)) throw new Error(`this browser's WebGL lacks ${name}`);
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, columns, rows);
  gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE)
    throw new Error("this browser's WebGL cannot draw into floats");
  gl.viewport(0, 0, columns, rows);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE);
  return gl;
}

function program(gl, [vertex, fragment]) {
  const made = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  return made;
}

const GL_TYPES = { uint8: "UNSIGNED_BYTE", uint16: "UNSIGNED_SHORT", int16: "SHORT", float16: "HALF_FLOAT",
  float32: "FLOAT" };

function attribute(gl, made, name, { type, shape, values }, divisor) {
  const place = gl.getAttribLocation(made, name);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
  gl.enableVertexAttribArray(place);
  gl.vertexAttribPointer(place, shape[1], gl[GL_TYPES[type]], false, 0, 0);
  gl.vertexAttribDivisor(place, divisor);
}

// Each kind: made once, returns what draws it with the uniforms that all share.
const KINDS = {
  gaussians(gl, part, arrays, made) {
    for (const [name, key] of [["centre", "centres"], ["scale", "scales"], ["quaternion", "quaternions"],
      ["amplitude", "amplitudes"]]) attribute(gl, made, name, arrays[key], 1);
    return () => gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, part.count);
  },
  surfaces(gl, part, arrays, made) {
    const { shape, values } = arrays.vertices;
    const places = Float32Array.from(values, (v) => part.low + part.step * v);
    return meshDrawer(gl, made, shape[0], arrays.faces, () => places);
  },
  paths(gl, part, arrays, made) {
    const [count, points] = arrays.coefficients.shape, raw = arrays.coefficients.values, w = arrays.weights.values;
    return meshDrawer(gl, made, points, arrays.faces, (time) => {
      const places = new Float32Array(3 * points);
      for (let k = 0; k < count; k++) {
        const weight = w[time * count + k], from = 3 * points * k;
        for (let i = 0; i < places.length; i++) places[i] += weight * (part.low + part.step * raw[from + i]);
      }
      return places;
    });
  },
  volume(gl, part, arrays, made) {
    const [channels, z, y, x] = arrays.values.shape;
    const textures = [0, Math.min(1, channels - 1)].map((c) => {
      const texture = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_3D, texture);
      gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
      gl.texImage3D(gl.TEXTURE_3D, 0, gl.R8, x, y, z, 0, gl.RED, gl.UNSIGNED_BYTE,
        arrays.values.values.subarray(c * x * y * z, (c + 1) * x * y * z));
      for (const axis of ["S", "T", "R"]) gl.texParameteri(gl.TEXTURE_3D, gl[`TEXTURE_WRAP_${axis}`], gl.CLAMP_TO_EDGE);
      for (const way of ["MIN", "MAG"]) gl.texParameteri(gl.TEXTURE_3D, gl[`TEXTURE_${way}_FILTER`], gl.LINEAR);
      return texture;
    });
    return () => {
      const at = (name) => gl.getUniformLocation(made, name);
      textures.forEach((texture, unit) => {
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.bindTexture(gl.TEXTURE_3D, texture);
        gl.uniform1i(at(["first", "second"][unit]), unit);
      });
      const both = (list) => [list[0], channels > 1 ? list[1] : 0];
      gl.uniform3fv(at("voxel"), part.voxel);
      gl.uniform3fv(at("middle"), part.middle);
      gl.uniform3f(at("counts"), x, y, z);
      gl.uniform2fv(at("lows"), both(part.low));
      gl.uniform2fv(at("steps"), both(part.step));
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    };
  },
};

function meshDrawer(gl, made, points, faces, placesAt) {
  const buffer = gl.createBuffer(), place = gl.getAttribLocation(made, "vertex");
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  gl.bufferData(gl.ARRAY_BUFFER, 12 * points, gl.DYNAMIC_DRAW);
  gl.enableVertexAttribArray(place);
  gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 0, 0);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces.values, gl.STATIC_DRAW);
  const type = faces.type === "uint16" ? gl.UNSIGNED_SHORT : gl.UNSIGNED_INT;
  let drawn = -1;
  return (time) => {
    if (time !== drawn) {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferSubData(gl.ARRAY_BUFFER, 0, placesAt(time));
      drawn = time;
    }
    gl.drawElements(gl.TRIANGLES, faces.values.length, type, 0);
  };
}

const RIM = [-0.375, -0.125, 0.125, 0.375];  // places in a pixel, across and down, at which surfaces are sampled

function drawerOf(gl, part, arrays) {
  const made = program(gl, SOURCES[part.kind === "paths" ? "surfaces" : part.kind]);
  const state = gl.createVertexArray();
  gl.bindVertexArray(state);
  const draw = KINDS[part.kind](gl, part, arrays, made);
  const scalar = part.kind === "gaussians", mesh = ["surfaces", "paths"].includes(part.kind);
  const places = mesh ? RIM : [0];  // the others are means over pixels already, or smooth
  return (R, time, shift) => {  // R: nine numbers, row by row; shift: of the detector [raster pixels]
    gl.useProgram(made);
    gl.bindVertexArray(state);
    gl.uniformMatrix3fv(gl.getUniformLocation(made, "R"), true, R);
    gl.uniform2f(gl.getUniformLocation(made, "frame"), columns, rows);
    if (scalar) {
      gl.uniform1f(gl.getUniformLocation(made, "low"), part.low);
      gl.uniform1f(gl.getUniformLocation(made, "step_"), part.step);
    }
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.uniform1f(gl.getUniformLocation(made, "weight"), places.length ** -2);
    for (const y of places) for (const x of places) {
      gl.uniform2f(gl.getUniformLocation(made, "shift"), shift[0] + x, shift[1] + y);
      draw(time);
    }
    const sums = new Float32Array(4 * rows * columns);
    gl.readPixels(0, 0, columns, rows, gl.RGBA, gl.FLOAT, sums);
    const delta = new Float32Array(rows * columns), beta = new Float32Array(rows * columns);
    part.channels.forEach(([d, b], c) => {
      for (let i = 0; i < delta.length; i++) {
        delta[i] += d * facts.pixel * sums[4 * i + c];
        beta[i] += b * facts.pixel * sums[4 * i + c];
      }
    });
    return { delta, beta };  // ∫δ and ∫β [m], row by row
  };
}

// --- waves -----------------------------------------------------------------------------------------------------

function fft(re, im, n, start, stride, inverse) {
  for (let i = 1, j = 0; i < n; i++) {
    let bit = n >> 1;
    for (; j & bit; bit >>= 1) j ^= bit;
    j ^= bit;
    if (i < j) for (const a of [re, im]) {
      const p = start + i * stride, q = start + j * stride;
      [a[p], a[q]] = [a[q], a[p]];
    }
  }
  for (let size = 2; size <= n; size <<= 1) {
    const half = size >> 1, angle = (inverse ? 2 : -2) * Math.PI / size;
    for (let k = 0; k < half; k++) {
      const c = Math.cos(angle * k), s = Math.sin(angle * k);
      for (let i = k; i < n; i += size) {
        const p = start + i * stride, q = p + half * stride;
        const x = re[q] * c - im[q] * s, y = re[q] * s + im[q] * c;
        re[q] = re[p] - x; im[q] = im[p] - y; re[p] += x; im[p] += y;
      }
    }
  }
}

function fft2(re, im, h, w, inverse) {
  for (let i = 0; i < h; i++) fft(re, im, w, i * w, 1, inverse);
  for (let j = 0; j < w; j++) fft(re, im, h, j, w, inverse);
}

const power = (n) => 2 ** Math.ceil(Math.log2(1.25 * n));
const frequency = (i, n) => (i < n / 2 ? i : i - n) / n;  // periods a raster pixel

// exp(-k B - i k D), the spectrum times exp(-i π λ z f²), |.|², the point-spread function; as docs/conventions.md.
function hologramOf({ delta, beta }) {
  const h = power(rows), w = power(columns), n = h * w, { k } = facts;
  const re = new Float64Array(n).fill(1), im = new Float64Array(n);
  const top = (h - rows) >> 1, left = (w - columns) >> 1;
  for (let i = 0; i < rows; i++) for (let j = 0; j < columns; j++) {
    const from = i * columns + j, to = (i + top) * w + j + left, size = Math.exp(-k * beta[from]);
    re[to] = size * Math.cos(k * delta[from]); im[to] = -size * Math.sin(k * delta[from]);
  }
  fft2(re, im, h, w, false);
  const reach = 2 * Math.PI * Math.PI * facts.distance / k / facts.pixel ** 2;  // π λ z / pixel²
  for (let i = 0; i < h; i++) for (let j = 0; j < w; j++) {
    const p = i * w + j, turn = -reach * (frequency(i, h) ** 2 + frequency(j, w) ** 2);
    const c = Math.cos(turn), s = Math.sin(turn), x = re[p];
    re[p] = (x * c - im[p] * s) / n; im[p] = (x * s + im[p] * c) / n;
  }
  fft2(re, im, h, w, true);
  for (let p = 0; p < n; p++) { re[p] = re[p] ** 2 + im[p] ** 2; im[p] = 0; }
  if (facts.psf > 0) {
    fft2(re, im, h, w, false);
    for (let i = 0; i < h; i++) for (let j = 0; j < w; j++) {
      const p = i * w + j, f2 = frequency(i, h) ** 2 + frequency(j, w) ** 2;
      const factor = Math.exp(-2 * (Math.PI * facts.psf) ** 2 * f2) / n;
      re[p] *= factor; im[p] *= factor;
    }
    fft2(re, im, h, w, true);
  }
  const found = new Float32Array(rows * columns);
  for (let i = 0; i < rows; i++) for (let j = 0; j < columns; j++)
    found[i * columns + j] = re[(i + top) * w + j + left];
  return found;
}

// --- what is seen ----------------------------------------------------------------------------------------------

function paint(canvas, width, height, values, colour) {
  canvas.width = width; canvas.height = height;
  const context = canvas.getContext("2d"), image = context.createImageData(width, height);
  for (let i = 0; i < width * height; i++) {
    const [r, g, b] = colour(values[i]);
    image.data.set([r, g, b, 255], 4 * i);
  }
  context.putImageData(image, 0, 0);
}

function shade(low, high, colours) {
  return (value) => {
    const i = Math.max(0, Math.min(255, Math.round(255 * (value - low) / (high - low))));
    return colours ? colours.slice(3 * i, 3 * i + 3) : [i, i, i];
  };
}

// Ends and colours of values from low to high: white at zero where they take more than one colour on either side of it.
function aroundZero(low, high) {
  const [least, most] = [Math.min(low, high), Math.max(low, high)], far = Math.max(-least, most);
  if (Math.min(-least, most) > (most - least) / 256) return [[-far, far], shade(-far, far, facts.signed)];
  return [[low, high], shade(low, high, facts.colours)];
}

// A number as people write it: 1.2e-7 becomes 1.2 × 10⁻⁷.
function text(value) {
  if (!value) return "0";
  const size = Math.abs(value);
  if (size >= 1e-3 && size < 1e5) return String(Number(value.toPrecision(3))).replace("-", "−");
  const [mantissa, power] = value.toExponential(1).split("e");
  const digits = String(Number(power)).replace(/./g, (c) => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".indexOf(c)]);
  return `${mantissa.replace("-", "−")} × 10${digits}`;
}

// A bar of colours from low to high beside the canvas `name`, whose numbers are `factor` times these.
function bar(name, low, high, colour, unit = "", factor = 1) {
  const canvas = pick(`${name}-colours`), values = Float32Array.from({ length: 64 }, (_, i) => high - (high - low) * i / 63);
  paint(canvas, 1, 64, values, colour);
  canvas.nextElementSibling.querySelector(".top").textContent = `${text(factor * high)} ${unit}`;
  canvas.nextElementSibling.querySelector(".low").textContent = text(factor * low);
}

// A scale bar of a round length, up to a quarter of `width` [m], on the canvas `name`.
function ruler(name, width) {
  const power = 10 ** Math.floor(Math.log10(width / 4)), length = [5, 2, 1].find((n) => n * power <= width / 4) * power;
  const [unit, factor] = length >= 0.9995e-3 ? ["mm", 1e3] : length >= 0.9995e-6 ? ["µm", 1e6] : ["nm", 1e9];
  const mark = pick(name).nextElementSibling;
  mark.style.width = `${100 * length / width}%`;
  mark.textContent = `${Number((length * factor).toPrecision(3))} ${unit}`;
}

function turned(yaw, pitch, R) {
  const [c, s, d, t] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
  const M = [c, 0, s, t * s, d, -t * c, -d * s, t, d * c];  // about y, then about x
  return [0, 1, 2].flatMap((i) => [0, 1, 2].map((j) => [0, 1, 2].reduce((a, m) => a + M[3 * i + m] * R[3 * m + j], 0)));
}

function sliceOf(part, arrays, plane, at) {  // plane: the axis across it, 0 x, 1 y, 2 z
  const [, Z, Y, X] = arrays.values.shape, raw = arrays.values.values;
  const [w, h] = [[Z, Y], [X, Z], [X, Y]][plane];
  const index = [(i, j) => (j * Y + i) * X + at, (i, j) => (i * Y + at) * X + j, (i, j) => (at * Y + i) * X + j][plane];
  const values = new Float32Array(w * h);
  for (let i = 0; i < h; i++) for (let j = 0; j < w; j++)
    values[i * w + j] = part.low[0] + part.step[0] * raw[index(i, j)];
  return { w, h, values };
}

function start(buffer) {
  const gl = contextOf(), drawers = {}, slices = {};
  for (const [name, part] of Object.entries(facts.parts)) drawers[name] = drawerOf(gl, part, arraysOf(part, buffer));
  for (const [name, part] of Object.entries(facts.slices)) slices[name] = { part, arrays: arraysOf(part, buffer) };
  const names = Object.keys(drawers);
  const state = { part: names[0], R: facts.rotations[0], shift: facts.shifts[0], time: 0, plane: 2, depth: 0 };
  const lines = (name, R, time = 0, shift = [0, 0]) => drawers[name](R, time, shift);
  const told = facts.delta_told, [name, unit, factor] = told ? ["Phase shift −φ", "rad", facts.k] : ["Absorption 2k∫β dz", "", 2 * facts.k];
  const lined = ({ delta, beta }) => (told ? delta : beta);
  const [cutName, cutUnit, cutFactor] = told ? ["δ", "", 1] : ["µ", "m⁻¹", 2 * facts.k];
  const [ends, warm] = aroundZero(...facts.phase), grey = shade(...facts.grey);
  let shown, pending = 0;

  function look() {
    shown = lines(state.part, state.R, state.time, state.shift);
    paint(pick("phase"), columns, rows, lined(shown).map((d) => factor * d), warm);
    clearTimeout(pending);
    pending = setTimeout(() => paint(pick("hologram"), columns, rows, hologramOf(shown), grey), 0);
  }

  function cut() {
    const { part, arrays } = slices[state.part] ?? Object.values(slices)[0];
    const count = arrays.values.shape[[3, 2, 1][state.plane]];
    pick("depth").max = count - 1;
    state.depth = Math.min(state.depth, count - 1);
    const { w, h, values } = sliceOf(part, arrays, state.plane, state.depth);
    const [low, top] = part.ends[0], full = top || (low < 0 ? 0 : 1);
    const [ends, colour] = aroundZero(...(-low > full ? [full, low] : [low, full]));  // what fills the field is dark
    paint(pick("slice"), w, h, values, colour);
    bar("slice", ...ends, colour, cutUnit, cutFactor);
    ruler("slice", w * facts.pixel * part.voxel[[2, 0, 0][state.plane]]);
    const axis = "xyz"[state.plane];
    const place = (state.depth + 0.5 - count / 2) * part.voxel[state.plane] + part.middle[state.plane];
    root.querySelector('output[name="depth"]').textContent = `${axis} = ${(1e6 * facts.pixel * place).toFixed(1)} µm`;
  }

  const turn = (yaw, pitch) => {
    Object.assign(state, { R: turned(yaw, pitch, state.R), shift: [0, 0] });
    pick("view").value = "";
    look();
  };
  const option = (text, value) => Object.assign(document.createElement("option"), { textContent: text, value });
  pick("part").append(...names.map((name) => option(name, name)));
  pick("view").append(option("any", ""), ...facts.labels.map((label, i) => option(label, i)));
  pick("view").value = "0";
  pick("part").onchange = (e) => { state.part = e.target.value; look(); cut(); };
  pick("view").onchange = ({ target: { value } }) => {
    if (value) { state.R = facts.rotations[value]; state.shift = facts.shifts[value]; look(); }
  };
  pick("plane").onchange = (e) => { state.plane = Number(e.target.value); cut(); };
  root.querySelector('input[name="depth"]').oninput = (e) => { state.depth = Number(e.target.value); cut(); };
  const moving = Object.values(facts.parts).find((part) => part.times_us);
  if (moving) {
    const slider = root.querySelector('input[name="time"]'), said = root.querySelector('output[name="time"]');
    root.querySelector(".time").hidden = false;
    slider.max = moving.times_us.length - 1;
    slider.oninput = () => { state.time = Number(slider.value); said.textContent = `${moving.times_us[state.time]} µs`; look(); };
    said.textContent = `${moving.times_us[0]} µs`;
  }
  const canvas = pick("phase");
  let held = null;
  canvas.onpointerdown = (e) => { held = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); };
  canvas.onpointerup = () => { held = null; };
  canvas.onpointermove = (e) => {
    if (held) {
      turn((e.clientX - held[0]) / 120, -(e.clientY - held[1]) / 120);
      held = [e.clientX, e.clientY];
    }
    const j = Math.floor(e.offsetX / canvas.clientWidth * columns), i = Math.floor(e.offsetY / canvas.clientHeight * rows);
    const value = factor * lined(shown)[i * columns + j];
    if (Number.isFinite(value)) pick("value").textContent = `· here ${text(value)} ${unit}`;
  };
  canvas.onkeydown = (e) => {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[e.key];
    if (way) { e.preventDefault(); turn(way[0] * Math.PI / 36, way[1] * Math.PI / 36); }
  };
  pick("shown").textContent = name;
  pick("slice-shown").textContent = `Slice of ${cutName}`;
  bar("phase", ...ends, warm, unit);
  bar("hologram", ...facts.grey, grey);
  for (const each of ["phase", "hologram"]) ruler(each, columns * facts.pixel);
  state.depth = Math.floor((Object.values(slices)[0]?.arrays.values.shape[1] ?? 1) / 2);
  root.querySelector('input[name="depth"]').max = 1e6;
  root.querySelector('input[name="depth"]').value = state.depth;
  look();
  if (Object.keys(slices).length) cut(); else pick("slice").parentElement.hidden = true;
  root.querySelector(".still").hidden = true;
  root.querySelector(".live").hidden = false;
  return { lines, hologram: (...of) => hologramOf(lines(...of)), turn, rows, columns };
}

const api = unpacked(root.querySelector(".data").textContent.trim()).then(start);
root.ready = api;
api.catch((error) => {
  const why = root.querySelector(".why");
  why.textContent = `The view cannot be turned here: ${error.message}.`;
  why.hidden = false;
});
})();
