// The interactive part of the report: linked cuts, 3D and frames of one scan. No dependency,
// no request; without WebGL2 the 3D part draws lines only, everything else stays.
(() => {
'use strict';
const $ = id => document.getElementById(id);
const data = JSON.parse($('viewer-data').textContent);
const PLANES = [[0, 1, 2], [0, 2, 1], [2, 1, 0]]; // right, down, through
const FAR_SHADE = 0.45, OPACITY = 90; // as in render.py
const DEPTH = [[255, 236, 110], [250, 140, 70], [214, 62, 110], [136, 60, 170], [60, 90, 235]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const clamp = (v, lo, hi) => Math.min(hi, Math.max(lo, v));
const css = name => getComputedStyle($('viewer')).getPropertyValue(name).trim();
const color = k => css('--run' + k % 4);
const state = { run: 0, cursor: null, frame: 0, yaw: data.camera[0], pitch: data.camera[1],
  zoom: 1, mode: 'render', black: 0, white: 255, strength: 0.9, moving: false };
let volume = null, companion = null, companionAt = null;
const decoded = new Map();

// ---- volumes --------------------------------------------------------------------------
async function load(index) {
  if (index === undefined || index === null || index < 0) return null;
  if (!decoded.has(index)) {
    const text = atob($('volume-' + index).textContent.trim());
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip'));
    const voxels = new Uint8Array(await new Response(stream).arrayBuffer());
    decoded.set(index, { ...data.volumes[index], voxels });
  }
  return decoded.get(index);
}
const toIndex = (v, p) => v.axes.map((axis, k) =>
  dot(axis, [p[0] - v.origin[0], p[1] - v.origin[1], p[2] - v.origin[2]]) / v.spacing[k]);
const toMm = (v, index) => [0, 1, 2].map(c =>
  v.origin[c] + v.axes.reduce((sum, axis, k) => sum + axis[c] * v.spacing[k] * index[k], 0));
const center = v => toMm(v, v.size.map(n => (n - 1) / 2));

/** Affine from voxel indices of one volume to those of another: three columns, an offset. */
function between(from, to) {
  const offset = toIndex(to, toMm(from, [0, 0, 0]));
  const columns = [0, 1, 2].map(k => {
    const unit = [0, 0, 0]; unit[k] = 1;
    return toIndex(to, toMm(from, unit)).map((v, c) => v - offset[c]);
  });
  return { offset, columns };
}

function tables() {
  const gray = new Uint32Array(256), hot = new Uint8Array(768), alpha = new Float32Array(256);
  const span = Math.max(1, state.white - state.black);
  const top = companion ? companion.window[1] : 255;
  for (let i = 0; i < 256; i++) {
    const g = clamp(Math.round((i - state.black) * 255 / span), 0, 255);
    gray[i] = 0xff000000 | g << 16 | g << 8 | g;
    const s = clamp(i / top, 0, 1);
    for (let c = 0; c < 3; c++) hot[3 * i + c] = 255 * clamp(3 * s - c, 0, 1);
    alpha[i] = clamp(s * 2.65, 0, 1) * state.strength;
  }
  return { gray, hot, alpha };
}

// ---- cuts -----------------------------------------------------------------------------
const scratch = document.createElement('canvas');
function fit(canvas, ratio = 1) {
  const w = Math.max(1, Math.round(canvas.clientWidth * ratio));
  const h = Math.max(1, Math.round(canvas.clientHeight * ratio));
  if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
  return [w, h];
}
function pixels(k, lut) {
  const [r, d, t] = PLANES[k], n = volume.size, stride = [1, n[0], n[0] * n[1]];
  const through = clamp(Math.round(toIndex(volume, state.cursor)[t]), 0, n[t] - 1);
  const image = new ImageData(n[r], n[d]), out = new Uint32Array(image.data.buffer);
  for (let j = 0, o = 0; j < n[d]; j++) {
    let at = through * stride[t] + j * stride[d];
    for (let i = 0; i < n[r]; i++, at += stride[r]) out[o++] = lut.gray[volume.voxels[at]];
  }
  if (companion) paintCompanion(image.data, lut, r, d, t, through);
  return image;
}
function paintCompanion(rgba, lut, r, d, t, through) {
  const { offset, columns } = companionAt, m = companion.size, n = volume.size;
  for (let j = 0, o = 0; j < n[d]; j++) for (let i = 0; i < n[r]; i++, o += 4) {
    const x = [0, 1, 2].map(c => Math.round(
      offset[c] + columns[r][c] * i + columns[d][c] * j + columns[t][c] * through));
    if (x[0] < 0 || x[1] < 0 || x[2] < 0 || x[0] >= m[0] || x[1] >= m[1] || x[2] >= m[2]) continue;
    const v = companion.voxels[x[0] + m[0] * (x[1] + m[1] * x[2])], a = lut.alpha[v];
    for (let c = 0; c < 3; c++) rgba[o + c] = rgba[o + c] * (1 - a) + lut.hot[3 * v + c] * a;
  }
}
function layout(k) {
  const ratio = window.devicePixelRatio || 1;
  const own = PLANES.map(([r, d], c) => {
    const [w, h] = fit($('cut-' + c), ratio);
    return Math.min(w / (volume.size[r] * volume.spacing[r]), h / (volume.size[d] * volume.spacing[d]));
  });
  // One scale for all three, unless that would make one of them tiny.
  const scale = Math.min(own[k], 1.8 * Math.min(...own)), [r, d] = PLANES[k], canvas = $('cut-' + k);
  const w = volume.size[r] * volume.spacing[r] * scale, h = volume.size[d] * volume.spacing[d] * scale;
  return { scale, ratio, left: (canvas.width - w) / 2, top: (canvas.height - h) / 2, w, h };
}
function drawCut(k, lut) {
  const canvas = $('cut-' + k), ctx = canvas.getContext('2d'), [r, d, t] = PLANES[k];
  const { scale, ratio, left, top, w, h } = layout(k), image = pixels(k, lut);
  scratch.width = image.width; scratch.height = image.height;
  scratch.getContext('2d').putImageData(image, 0, 0);
  ctx.fillStyle = '#000'; ctx.fillRect(0, 0, canvas.width, canvas.height);
  ctx.imageSmoothingEnabled = true;
  ctx.drawImage(scratch, left, top, w, h);
  const index = toIndex(volume, state.cursor);
  const across = i => left + (i + 0.5) * volume.spacing[r] * scale;
  const along = j => top + (j + 0.5) * volume.spacing[d] * scale;
  const through = clamp(Math.round(index[t]), 0, volume.size[t] - 1);
  ctx.lineWidth = ratio; ctx.strokeStyle = 'rgba(130,220,255,.55)';
  ctx.beginPath();
  ctx.moveTo(left, along(index[d])); ctx.lineTo(left + w, along(index[d]));
  ctx.moveTo(across(index[r]), top); ctx.lineTo(across(index[r]), top + h);
  ctx.stroke();
  drawFrameInCut(ctx, k, through, across, along, ratio);
  scaleBar(ctx, canvas, scale, ratio);
  const slider = $('slice-' + k);
  slider.max = volume.size[t] - 1; slider.value = through;
  $('where-' + k).textContent = `${volume.names[t]} ${(through * volume.spacing[t]).toFixed(1)} mm`;
  $('name-' + k).textContent = `${volume.names[r]} → · ${volume.names[d]} ↓`;
}
/** The line in which the frame being looked at crosses a cut. */
function drawFrameInCut(ctx, k, through, across, along, ratio) {
  const corners = frameCorners(state.run, state.frame);
  if (!corners) return;
  const [r, d, t] = PLANES[k], ring = corners.map(p => toIndex(volume, p)), hits = [];
  for (let i = 0; i < 4; i++) {
    const a = ring[i], b = ring[(i + 1) % 4], s = (through - a[t]) / (b[t] - a[t]);
    if (s >= 0 && s <= 1) hits.push([a[r] + s * (b[r] - a[r]), a[d] + s * (b[d] - a[d])]);
  }
  if (hits.length < 2) return;
  ctx.strokeStyle = color(state.run); ctx.lineWidth = 2 * ratio;
  ctx.beginPath();
  ctx.moveTo(across(hits[0][0]), along(hits[0][1]));
  ctx.lineTo(across(hits[1][0]), along(hits[1][1]));
  ctx.stroke();
}
function scaleBar(ctx, canvas, scale, ratio) {
  const limit = 0.3 * canvas.width / scale, power = 10 ** Math.floor(Math.log10(limit));
  const mm = [5, 2, 1].map(f => f * power).find(v => v <= limit);
  const x = 12 * ratio, y = canvas.height - 12 * ratio;
  ctx.fillStyle = '#fff'; ctx.fillRect(x, y, mm * scale, 3 * ratio);
  ctx.font = `${12 * ratio}px system-ui,sans-serif`; ctx.textAlign = 'left';
  ctx.fillText(`${+mm.toPrecision(3)} mm`, x, y - 5 * ratio);
}
function pick(k, event) {
  const canvas = $('cut-' + k), box = canvas.getBoundingClientRect(), [r, d] = PLANES[k];
  const { scale, ratio, left, top } = layout(k), index = toIndex(volume, state.cursor);
  const at = [(event.clientX - box.left) * ratio - left, (event.clientY - box.top) * ratio - top];
  [r, d].forEach((axis, i) => {
    index[axis] = clamp(at[i] / scale / volume.spacing[axis] - 0.5, 0, volume.size[axis] - 1);
  });
  state.cursor = toMm(volume, index);
  redraw();
}

// ---- frames ---------------------------------------------------------------------------
function frameCorners(run, frame) {
  if (!data.frame_size || !data.runs[run].poses[frame]) return null;
  const [w, h] = data.frame_size;
  return [[0, 0], [w, 0], [w, h], [0, h]].map(([x, y]) => posed(data.runs[run].poses[frame], x, y));
}
const posed = (m, x, y) => [0, 1, 2].map(c => m[4 * c] * x + m[4 * c + 1] * y + m[4 * c + 3]);
const sheet = $('cine-sheet');
function tile(frame) {
  const c = data.cine;
  return [frame % c.across * c.width, Math.floor(frame / c.across) * c.height, c.width, c.height];
}
function drawCine() {
  const canvas = $('v-cine');
  if (!canvas || !data.cine || !sheet.naturalWidth) return;
  const ratio = window.devicePixelRatio || 1, [w, h] = fit(canvas, ratio), ctx = canvas.getContext('2d');
  const [mm_w, mm_h] = data.frame_size || [data.cine.width, data.cine.height];
  const scale = Math.min(w / mm_w, h / mm_h), dw = mm_w * scale, dh = mm_h * scale;
  ctx.fillStyle = '#000'; ctx.fillRect(0, 0, w, h);
  ctx.imageSmoothingQuality = 'high';
  ctx.drawImage(sheet, ...tile(state.frame), (w - dw) / 2, (h - dh) / 2, dw, dh);
  if (data.frame_size) scaleBar(ctx, canvas, scale, ratio);
}
function moveCursors() {
  const real = data.shown[state.frame];
  document.querySelectorAll('line.cursor').forEach(line => {
    const s = line.dataset, f = (real - s.from) / (s.to - s.from);
    line.setAttribute('visibility', f >= 0 && f <= 1 ? 'visible' : 'hidden');
    line.setAttribute('x1', +s.left + f * s.width); line.setAttribute('x2', +s.left + f * s.width);
  });
  document.querySelectorAll('path.frame-cursor').forEach(path => {
    const corners = frameCorners(+path.dataset.run, state.frame), m = path.dataset.project.split(' ').map(Number);
    if (!corners) return;
    const flat = corners.map(p => [0, 4].map(o => (m[o] * p[0] + m[o + 1] * p[1] + m[o + 2] * p[2] + m[o + 3]).toFixed(1)));
    path.setAttribute('d', `M${flat.map(p => p.join(' ')).join('L')}Z`);
  });
  $('v-frame').value = state.frame;
  $('v-frame-name').textContent = `frame ${real} of ${data.frames}`;
}

// ---- 3D -------------------------------------------------------------------------------
const VERTEX = `#version 300 es
in vec2 at; out vec2 p; void main() { p = at; gl_Position = vec4(at, 0, 1); }`;
const FRAGMENT = `#version 300 es
precision highp float; precision highp sampler3D;
in vec2 p; out vec4 color;
uniform sampler3D voxels, other; uniform bool hasOther; uniform mat3 toTexture; uniform vec3 middle;
uniform vec2 halfSize, grayWindow, otherWindow; uniform float reach, opacity; uniform int steps, mode;
uniform mat4 toOther; uniform vec4 depthOf; uniform vec3 ramp[5];
vec3 hot(float s) { return clamp(vec3(3.*s, 3.*s-1., 3.*s-2.), 0., 1.); }
vec3 deep(float s) { float f = clamp(s, 0., 1.)*3.999; int i = int(f); return mix(ramp[i], ramp[i+1], f-float(i)); }
void main() {
  vec3 from = middle + toTexture*vec3(p*halfSize, -reach), way = toTexture*vec3(0, 0, 2.*reach);
  vec3 inverse = 1./(way + vec3(equal(way, vec3(0)))*1e-9);
  vec3 a = -from*inverse, b = (1.-from)*inverse, near = min(a, b), far = max(a, b);
  float enter = max(max(near.x, near.y), max(near.z, 0.)), leave = min(min(far.x, far.y), min(far.z, 1.));
  color = vec4(0, 0, 0, 1);
  if (enter >= leave) return;
  float stride = 1./float(steps), best = 0., strongest = 0., light = 0., passing = 1.;
  vec3 bestAt = from;
  for (int i = int(ceil(enter/stride)); i < int(leave/stride); i++) {
    float s = float(i)*stride; vec3 x = from + way*s;
    float v = clamp((texture(voxels, x).r - grayWindow.x)/(grayWindow.y - grayWindow.x), 0., 1.);
    if (hasOther) {
      vec3 y = (toOther*vec4(x, 1)).xyz;
      if (all(greaterThan(y, vec3(0))) && all(lessThan(y, vec3(1))))
        strongest = max(strongest, clamp(texture(other, y).r/otherWindow.y, 0., 1.));
    }
    if (mode == 0) {
      float alpha = min(1., opacity*v*v);
      light += passing*alpha*(1. - ${(1 - FAR_SHADE).toFixed(2)}*(s-enter))*(.35+.65*v); passing *= 1.-alpha;
      if (passing < .02 && !hasOther) break;
    } else if (v > best) { best = v; bestAt = x; }
  }
  vec3 base = mode == 0 ? vec3(light) : mode == 1 ? vec3(best) : deep(dot(depthOf, vec4(bestAt, 1)))*best;
  color = vec4(hasOther ? mix(base*.6, hot(strongest), clamp(2.*strongest, 0., .95)) : base, 1);
}`;
const gl3d = { gl: null };
function startGl() {
  const gl = $('v-gl').getContext('webgl2', { antialias: false, preserveDrawingBuffer: true });
  if (!gl) return;
  const program = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source); gl.compileShader(shader); gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return;
  gl.useProgram(program);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 3, -1, -1, 3]), gl.STATIC_DRAW);
  const at = gl.getAttribLocation(program, 'at');
  gl.enableVertexAttribArray(at); gl.vertexAttribPointer(at, 2, gl.FLOAT, false, 0, 0);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  Object.assign(gl3d, { gl, program, slow: 0, textures: [gl.createTexture(), gl.createTexture()] });
  $('v-gl').addEventListener('webglcontextlost', () => { gl3d.gl = null; redraw(); });
}
function upload(unit, v) {
  const { gl, textures } = gl3d;
  if (!gl) return;
  if (Math.max(...v.size) > gl.getParameter(gl.MAX_3D_TEXTURE_SIZE)) { gl3d.gl = null; return; }
  gl.activeTexture(gl.TEXTURE0 + unit); gl.bindTexture(gl.TEXTURE_3D, textures[unit]);
  for (const name of ['MIN', 'MAG']) gl.texParameteri(gl.TEXTURE_3D, gl[`TEXTURE_${name}_FILTER`], gl.LINEAR);
  for (const name of ['S', 'T', 'R']) gl.texParameteri(gl.TEXTURE_3D, gl['TEXTURE_WRAP_' + name], gl.CLAMP_TO_EDGE);
  gl.texImage3D(gl.TEXTURE_3D, 0, gl.R8, ...v.size, 0, gl.RED, gl.UNSIGNED_BYTE, v.voxels);
}
/** Rows: right, down and away on the screen, as directions in the reference. */
function screenAxes() {
  const [a, e, f] = [state.yaw, state.pitch, data.first_axes];
  const [ca, sa, ce, se] = [Math.cos(a), Math.sin(a), Math.cos(e), Math.sin(e)];
  const turn = [[ca, 0, -sa], [-se * sa, ce, -se * ca], [ce * sa, se, ce * ca]];
  return turn.map(row => [0, 1, 2].map(c => row[0] * f[0][c] + row[1] * f[1][c] + row[2] * f[2][c]));
}
const diagonal = v => Math.hypot(...v.size.map((n, k) => n * v.spacing[k]));
// The frames say what matters; the volume's box may be much larger.
const extentMm = () => data.frame_size || !volume ? data.extent : diagonal(volume);
const pivot = () => data.frame_size || !volume ? data.pivot : center(volume);
function drawGl() {
  const { gl, program } = gl3d, canvas = $('v-gl');
  canvas.style.visibility = gl && volume ? 'visible' : 'hidden';
  $('v-nogl').hidden = !!gl || !volume;
  if (!gl || !volume) return;
  const ratio = Math.min(window.devicePixelRatio || 1, 1.5);
  const [w, h] = fit(canvas, state.moving && gl3d.slow > 40 ? 0.45 : ratio);
  const u = name => gl.getUniformLocation(program, name), rows = screenAxes(), mid = toIndex(volume, pivot());
  const half = extentMm() / 2 / state.zoom / Math.min(1, w / h) * 0.9;
  const texture = volume.axes.map((axis, k) => rows.map(row => dot(axis, row) / (volume.size[k] * volume.spacing[k])));
  gl.viewport(0, 0, w, h);
  gl.uniformMatrix3fv(u('toTexture'), true, texture.flat());
  gl.uniform3f(u('middle'), ...mid.map((x, k) => (x + 0.5) / volume.size[k]));
  gl.uniform2f(u('halfSize'), half * w / h, -half);
  const away = center(volume).map((x, c) => x - pivot()[c]), reach = diagonal(volume) / 2 + Math.hypot(...away);
  gl.uniform1f(u('reach'), reach);
  const fine = state.moving ? 160 : 420;
  gl.uniform1i(u('steps'), fine);
  gl.uniform1f(u('opacity'), OPACITY * 2 * reach / diagonal(volume) / fine);
  gl.uniform2f(u('grayWindow'), state.black / 255, Math.max(state.white, state.black + 1) / 255);
  gl.uniform1i(u('mode'), ['render', 'maximum', 'depth'].indexOf(state.mode));
  gl.uniform3fv(u('ramp'), DEPTH.flat().map(c => c / 255));
  gl.uniform4fv(u('depthOf'), depthPlane());
  gl.uniform1i(u('voxels'), 0); gl.uniform1i(u('other'), 1); gl.uniform1i(u('hasOther'), companion ? 1 : 0);
  if (companion) {
    gl.uniform2f(u('otherWindow'), 0, companion.window[1] / 255);
    gl.uniformMatrix4fv(u('toOther'), false, textureToTexture());
  }
  const start = performance.now();
  gl.drawArrays(gl.TRIANGLES, 0, 3);
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  if (!state.moving) gl3d.slow = performance.now() - start;
}
/** Depth along the first frame's axial axis, 0 to 1 over the volume, from texture coordinates. */
function depthPlane() {
  const down = data.first_axes[1];
  const slope = volume.axes.map((axis, k) => dot(axis, down) * volume.size[k] * volume.spacing[k]);
  const low = slope.reduce((s, v) => s + Math.min(v, 0), 0), span = slope.reduce((s, v) => s + Math.abs(v), 0);
  return [...slope.map(v => v / span), -low / span];
}
function textureToTexture() {
  const { offset, columns } = companionAt, n = volume.size, m = companion.size;
  const first = [0, 1, 2].map(c => offset[c] - (columns[0][c] + columns[1][c] + columns[2][c]) / 2);
  return [...[0, 1, 2].flatMap(k => [...[0, 1, 2].map(c => columns[k][c] * n[k] / m[c]), 0]),
    ...first.map((v, c) => (v + 0.5) / m[c]), 1];
}
function drawLines() {
  const canvas = $('v-lines'), ratio = window.devicePixelRatio || 1, [w, h] = fit(canvas, ratio);
  const ctx = canvas.getContext('2d'), rows = screenAxes(), c = pivot();
  const half = extentMm() / 2 / state.zoom / Math.min(1, w / h) * 0.9, scale = h / 2 / half;
  const at = p => { const q = [p[0] - c[0], p[1] - c[1], p[2] - c[2]];
    return [w / 2 + dot(rows[0], q) * scale, h / 2 + dot(rows[1], q) * scale]; };
  const stroke = (points, style, width, closed) => {
    ctx.beginPath(); points.map(at).forEach((p, i) => i ? ctx.lineTo(...p) : ctx.moveTo(...p));
    if (closed) ctx.closePath();
    ctx.strokeStyle = style; ctx.lineWidth = width * ratio; ctx.stroke();
  };
  ctx.setTransform(1, 0, 0, 1, 0, 0); ctx.clearRect(0, 0, w, h); ctx.lineJoin = 'round';
  if (volume) boxEdges(volume).forEach(edge => stroke(edge, 'rgba(150,170,190,.35)', 1));
  if ($('v-show-frame').checked) drawTile(ctx, at);
  ctx.setTransform(1, 0, 0, 1, 0, 0);
  data.runs.forEach((run, k) => {
    const every = Math.max(1, Math.ceil(run.poses.length / 10)), middle = (data.frame_size || [0, 0])[0] / 2;
    ctx.globalAlpha = 0.55;
    if ($('v-show-outlines').checked && data.frame_size)
      for (let f = 0; f < run.poses.length; f += every) stroke(frameCorners(k, f), color(k), 1, true);
    ctx.globalAlpha = 1;
    stroke(run.poses.map(m => posed(m, middle, 0)), color(k), 3);
  });
  const corners = frameCorners(state.run, state.frame);
  if (corners) stroke(corners, '#fff', 1.6, true);
  scaleBar(ctx, canvas, scale, ratio);
}
/** The frame itself, where it was in space: without perspective that is an affine map. */
function drawTile(ctx, at) {
  const corners = frameCorners(state.run, state.frame);
  if (!corners || !data.cine || !sheet.naturalWidth) return;
  const [o, right, , down] = corners.map(at), [sx, sy, sw, sh] = tile(state.frame);
  ctx.setTransform((right[0] - o[0]) / sw, (right[1] - o[1]) / sw, (down[0] - o[0]) / sh, (down[1] - o[1]) / sh, o[0], o[1]);
  ctx.drawImage(sheet, sx, sy, sw, sh, 0, 0, sw, sh);
}
function boxEdges(v) {
  const corner = bits => toMm(v, v.size.map((n, k) => (bits >> k & 1 ? n - 0.5 : -0.5))), edges = [];
  for (let a = 0; a < 8; a++) for (let k = 0; k < 3; k++)
    if (!(a >> k & 1)) edges.push([corner(a), corner(a | 1 << k)]);
  return edges;
}

// ---- page -----------------------------------------------------------------------------
let waiting = 0, settle = 0;
function redraw(moving = false) {
  state.moving = moving;
  clearTimeout(settle);
  if (moving) settle = setTimeout(() => redraw(), 160);
  if (!waiting) waiting = requestAnimationFrame(() => { waiting = 0; draw(); });
}
function draw() {
  if (volume) {
    const lut = tables();
    [0, 1, 2].forEach(k => drawCut(k, lut));
    const i = toIndex(volume, state.cursor).map((x, k) => clamp(Math.round(x), 0, volume.size[k] - 1));
    const real = v => +(volume.offset + volume.scale * v).toPrecision(4);
    const here = volume.voxels[i[0] + volume.size[0] * (i[1] + volume.size[1] * i[2])];
    $('v-read').textContent = `(${state.cursor.map(x => x.toFixed(1)).join(', ')}) mm: ${real(here)}` +
      ` · black ${real(state.black)}, white ${real(state.white)}`;
  }
  drawGl(); drawLines(); drawCine(); moveCursors();
}
async function chooseRun(run) {
  state.run = run;
  volume = await load(data.runs[run].volume);
  const overlays = data.runs[run].companions, select = $('v-overlay'), old = select.value;
  select.replaceChildren(new Option('none', -1), ...overlays.map(c => new Option(c.name, c.volume)));
  select.parentElement.hidden = !overlays.length;
  const same = [...select.options].find(o => o.text === old); if (same) select.value = same.value;
  if (volume) {
    if (!state.cursor) {
      [state.black, state.white] = volume.window;
      state.cursor = toMm(volume, volume.start); syncWindow();
    }
    upload(0, volume);
  }
  await chooseOverlay(+select.value);
}
async function chooseOverlay(index) {
  companion = volume ? await load(index) : null;
  if (companion) { companionAt = between(volume, companion); upload(1, companion); }
  redraw();
}
function syncWindow() {
  $('v-level').value = (state.black + state.white) / 2; $('v-window').value = state.white - state.black;
}
function drag(target, move) {
  target.addEventListener('pointerdown', e => { target.setPointerCapture(e.pointerId); move(e, true); });
  target.addEventListener('pointermove', e => { if (target.hasPointerCapture(e.pointerId)) move(e, false); });
}
function connect() {
  data.runs.forEach((run, k) => $('v-run').append(new Option(run.name, k)));
  $('v-run').parentElement.hidden = data.runs.length < 2;
  $('v-run').onchange = e => chooseRun(+e.target.value);
  $('v-overlay').onchange = e => chooseOverlay(+e.target.value);
  $('v-mode').onchange = e => { state.mode = e.target.value; redraw(); };
  for (const id of ['v-show-frame', 'v-show-outlines']) $(id).onchange = () => redraw();
  for (const id of ['v-level', 'v-window']) $(id).oninput = () => {
    state.black = $('v-level').value - $('v-window').value / 2; state.white = state.black + +$('v-window').value;
    redraw(true);
  };
  PLANES.forEach(([, , t], k) => {
    drag($('cut-' + k), e => pick(k, e));
    $('slice-' + k).oninput = e => {
      const index = toIndex(volume, state.cursor); index[t] = +e.target.value;
      state.cursor = toMm(volume, index); redraw();
    };
  });
  let last = null;
  drag($('v-lines'), (e, first) => {
    if (!first) {
      state.yaw -= (e.clientX - last[0]) / 150;
      state.pitch = clamp(state.pitch + (e.clientY - last[1]) / 150, -1.57, 1.57);
      redraw(true);
    }
    last = [e.clientX, e.clientY];
  });
  $('v-zoom').oninput = e => { state.zoom = +e.target.value; redraw(true); };
  $('v-frame').max = data.shown.length - 1;
  $('v-frame').oninput = e => { state.frame = +e.target.value; redraw(true); };
  let playing = 0;
  $('v-play').onclick = () => {
    if (playing) { clearInterval(playing); playing = 0; }
    else playing = setInterval(() => { state.frame = (state.frame + 1) % data.shown.length; redraw(true); }, 66);
    $('v-play').textContent = playing ? 'Pause' : 'Play';
  };
  sheet?.addEventListener('load', () => redraw());
  new ResizeObserver(() => redraw()).observe($('viewer'));
}
async function start() {
  try {
    $('viewer').hidden = false;
    for (const part of document.querySelectorAll('[data-needs=volume]')) part.hidden = data.runs.every(r => r.volume < 0);
    for (const part of document.querySelectorAll('[data-needs=cine]')) part.hidden = !data.cine;
    startGl(); connect();
    await chooseRun(Math.max(0, data.runs.findIndex(r => r.volume >= 0)));
    $('v-run').value = state.run;
    document.documentElement.dataset.viewer = gl3d.gl ? 'webgl' : 'canvas';
  } catch (error) {
    // The pictures below remain; a browser without DecompressionStream ends here.
    $('viewer').hidden = true; $('viewer-failed').hidden = false;
    console.warn('interactive view not available: ' + error.message);
  }
}
start();
})();
