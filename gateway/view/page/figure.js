// The robot in three dimensions: its parts as plain solids and meshes, each as its joint stands. Metres; x forward, y to
// the left, z up. Drawn by WebGL 2, when something has changed; what is lowest stands on the floor.

import { $, Drawing, make, number, setText } from "./elements.js";

const SIDES = 24; // of what is round
const LENS = 0.6; // rad, across the shorter side
const GROWN = 1.05; // so much larger than when it was last fitted
const PITCH = [-0.3, 1.5]; // rad, of the view
const CORNERS = [-1, 1].flatMap(x => [-1, 1].flatMap(y => [-1, 1].map(z => [x, y, z])));
const VERTEX = `#version 300 es
uniform mat4 model, view, lens; in vec3 at; out vec3 seen;
void main() { vec4 p = view * model * vec4(at, 1); seen = p.xyz; gl_Position = lens * p; }`;
const FRAGMENT = `#version 300 es
precision highp float; in vec3 seen; uniform vec3 colour; uniform bool lit; out vec4 drawn;
void main() {
  vec3 face = normalize(cross(dFdx(seen), dFdy(seen)));
  drawn = vec4(lit ? colour * (0.5 + 0.5 * max(0.0, dot(face, vec3(0.33, 0.66, 0.67)))) : colour, 1);
}`;

export class Figure extends Drawing {
  constructor() {
    super();
    Object.assign(this, { canvas: $("figure-canvas"), parts: [], items: [], meshes: [], at: [], pointers: new Map(), names: [] });
    this.gl = this.canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
    $("figure-none").hidden = Boolean(this.gl);
    if (this.gl) this.prepare();
    new ResizeObserver(() => this.resize()).observe(this.canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.change());
    this.canvas.addEventListener("webglcontextlost", event => event.preventDefault());
    this.canvas.addEventListener("webglcontextrestored", () => {
      this.prepare();
      this.items = [];
      this.build();
    });
    this.canvas.addEventListener("wheel", event => {
      event.preventDefault();
      this.zoom(Math.exp(event.deltaY / 500));
    }, { passive: false });
    this.canvas.addEventListener("contextmenu", event => event.preventDefault());
    this.canvas.addEventListener("pointerdown", event => this.down(event));
    this.canvas.addEventListener("pointermove", event => this.move(event));
    for (const type of ["pointerup", "pointercancel", "lostpointercapture"])
      this.canvas.addEventListener(type, event => this.pointers.delete(event.pointerId));
    this.canvas.addEventListener("keydown", event => this.key(event));
    $("figure-near").addEventListener("click", () => this.zoom(1 / 1.3));
    $("figure-far").addEventListener("click", () => this.zoom(1.3));
    $("figure-fit").addEventListener("click", () => this.fit());
    for (const which of ["axes", "values"])
      $(`figure-${which}`).addEventListener("click", () => this.press(which, !this[which]));
  }

  // Show another robot, of which `figure` has the parts.
  reset({ figure = [], missing = [], base }) {
    const same = JSON.stringify(figure) === this.known;
    $("figure-panel").hidden = !figure.length;
    if (base) $("drive").after($("figure-panel"));
    else $("beside").append($("figure-panel"));
    setText($("figure-missing"), missing.length ? `not drawn: ${missing.join("; ")}` : "");
    this.meshes = [];
    this.at = [];
    this.known = JSON.stringify(figure);
    this.parts = figure.map(part => ({ ...part, frame: placed(part.at), turned: IDENTITY }));
    const moved = this.parts.filter(part => part.motor);
    const linked = moved.some(part => this.above(part).some(one => one.motor));
    this.names = moved.map(() => make("span", { className: "num" }));
    $("figure-names").replaceChildren(...this.names);
    if (!same) {
      $("figure").open = linked || !base;
      this.press("axes", linked);
      this.press("values", linked && moved.length <= 8);
    }
    this.build();
    if (!same) this.fit();
  }

  above({ carrier }) {
    return carrier < 0 ? [] : [this.parts[carrier], ...this.above(this.parts[carrier])];
  }

  // Take how the parts that motors move stand: rad or m; null: not known.
  take(at = []) {
    if (at.length === this.at.length && at.every((one, i) => one === this.at[i])) return;
    const first = !this.at.length;
    this.at = at;
    if (first && !this.touched) this.fit();
    this.change();
  }

  takeMesh({ mesh, low, step, count }, { buffer, offset }) {
    const corners = new Uint16Array(buffer, offset, 9 * count);
    const piece = Array.from(corners, (one, i) => low[i % 3] + step * one);
    (this.meshes[mesh] ??= []).push(piece);
    this.parts.forEach((part, i) => part.shapes.forEach(shape => shape.mesh === mesh && this.add(i, shape, piece)));
    if (!this.touched) this.fit();
    this.change();
  }

  press(which, on) {
    this[which] = on;
    $(`figure-${which}`).setAttribute("aria-pressed", on);
    this.change();
  }

  // -- what is drawn --------------------------------------------------------------------------------

  prepare() {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "at");
    gl.linkProgram(program);
    gl.useProgram(program);
    gl.enableVertexAttribArray(0);
    this.uniform = Object.fromEntries(["model", "view", "lens", "colour", "lit"].map(name => [name, gl.getUniformLocation(program, name)]));
    const grid = [...Array(11).keys()].flatMap(i => [i - 5, -5, 0, i - 5, 5, 0, -5, i - 5, 0, 5, i - 5, 0]);
    this.grid = this.store(grid);
    this.axis = this.store([0, 0, 0, 1, 0, 0]);
  }

  store(corners) {
    const { gl } = this, buffer = gl?.createBuffer();
    gl?.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl?.bufferData(gl.ARRAY_BUFFER, new Float32Array(corners), gl.STATIC_DRAW);
    return { buffer, count: corners.length / 3 };
  }

  build() {
    for (const { solid } of this.items) this.gl?.deleteBuffer(solid.buffer);
    this.items = [];
    this.parts.forEach((part, i) => part.shapes.forEach(shape => {
      if (shape.kind in SOLIDS) this.add(i, shape, SOLIDS[shape.kind](...shape.size));
      else for (const piece of this.meshes[shape.mesh] ?? []) this.add(i, shape, piece);
    }));
    this.change();
  }

  // Add a solid of a part: the corners of its triangles.
  add(part, { at, colour, kind, size }, corners) {
    const scale = kind === "mesh" ? size : [1, 1, 1];
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    corners.forEach((one, i) => {
      low[i % 3] = Math.min(low[i % 3], one);
      high[i % 3] = Math.max(high[i % 3], one);
    });
    const box = CORNERS.map(signs => signs.map((sign, i) => (sign < 0 ? low[i] : high[i])));
    this.items.push({ part, colour, box, solid: this.store(corners), frame: product(placed(at), scaled(...scale)) });
  }

  // Find where everything is.
  stand() {
    let moved = 0;
    for (const part of this.parts) {
      let at = part.rest;
      if (part.motor) at = this.at[moved++] ?? part.rest;
      const motion = part.slides ? shifted(...part.axis.map(one => one * at)) : turned(part.axis, at);
      const frame = product(part.frame, motion);
      part.turned = part.carrier < 0 ? frame : product(this.parts[part.carrier].turned, frame);
    }
    const points = this.items.flatMap(({ part, frame, box }) => {
      const whole = product(this.parts[part].turned, frame);
      return box.map(corner => moved3(whole, corner));
    });
    const ends = pick => [0, 1, 2].map(i => points.reduce((most, point) => pick(most, point[i]), pick === Math.min ? Infinity : -Infinity));
    return points.length ? [ends(Math.min), ends(Math.max)] : [[-0.5, -0.5, 0], [0.5, 0.5, 1]];
  }

  // Look at all of it, from before and aside.
  fit() {
    const [low, high] = this.stand();
    const size = diagonal(low, high);
    Object.assign(this, { touched: false, yaw: 0.7, pitch: 0.35, distance: 1.65 * size, size });
    this.target = high.map((one, i) => (one + low[i]) / 2);
    this.floor = low[2];
    this.change();
  }

  draw() {
    const { gl, canvas, parts, items } = this;
    if (!gl || gl.isContextLost() || !canvas.clientWidth || !parts.length) return;
    if (this.ratio !== window.devicePixelRatio) return this.resize();
    const [low, high] = this.stand(), floor = low[2]; // of legs that fold the trunk sinks: they stay on it
    if (!this.touched && diagonal(low, high) > GROWN * this.size) this.fit(); // an arm that stretches is seen whole
    const { yaw, pitch, distance, target, size } = this;
    const middle = [target[0], target[1], target[2] - this.floor + floor];
    const view = looking(middle, yaw, pitch, distance);
    const lens = perspective(canvas.width / canvas.height, distance / 50, distance * 20);
    const style = getComputedStyle(document.documentElement);
    const colour = name => rgb(style.getPropertyValue(name).trim());
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...colour("--map-free"), 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(this.uniform.view, false, view);
    gl.uniformMatrix4fv(this.uniform.lens, false, lens);
    const put = ({ buffer, count }, how, model, shown, lit) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
      gl.uniformMatrix4fv(this.uniform.model, false, model);
      gl.uniform3fv(this.uniform.colour, shown);
      gl.uniform1i(this.uniform.lit, lit);
      gl.drawArrays(how, 0, count);
    };
    gl.enable(gl.DEPTH_TEST);
    const cell = 10 ** Math.round(Math.log10(size / 3));
    put(this.grid, gl.LINES, product(shifted(0, 0, floor), scaled(cell, cell, 1)), colour("--line"), false);
    const [one, other] = ["--map-robot", "--map-raw"].map(name => colour(name).map(part => 0.3 + 0.7 * part)); // for lines to be seen on them
    for (const { part, frame, solid, colour: own } of items)
      put(solid, gl.TRIANGLES, product(parts[part].turned, frame), own ?? (this.above(parts[part]).length % 2 ? one : other), true);
    gl.disable(gl.DEPTH_TEST);
    const moves = parts.filter(part => part.motor);
    const length = 0.09 * size;
    if (this.axes) for (const { turned: frame } of [{ turned: shifted(0, 0, floor) }, ...moves])
      [[0, 0], [2, Math.PI / 2], [1, -Math.PI / 2]].forEach(([about, angle], i) => { // x red, y green, z blue
        const along = about === 0 ? IDENTITY : turned([0, 0, 0].map((_, k) => Number(k === about)), angle);
        put(this.axis, gl.LINES, product(product(frame, along), scaled(length, length, length)), [[0.85, 0.1, 0.1], [0.1, 0.6, 0.15], [0.2, 0.35, 0.95]][i], false);
      });
    $("figure-names").hidden = !this.values;
    if (this.values) this.label(moves, product(lens, view));
  }

  // Write beside each joint how it stands; of names that would cover one another the next is put below.
  label(moves, whole) {
    const { clientWidth, clientHeight } = this.canvas, taken = [];
    moves.map((part, i) => {
      const [x, y, , w] = moved4(whole, [part.turned[12], part.turned[13], part.turned[14]]);
      return { part, i, left: ((x / w + 1) / 2) * clientWidth, top: ((1 - y / w) / 2) * clientHeight };
    }).sort((a, b) => a.top - b.top).forEach(({ part, i, left, top }) => {
      const shown = this.names[i], value = this.at[i];
      setText(shown, `${part.motor} ${number(value, 2, part.slides ? "m" : "rad")}`);
      const width = 7 * shown.textContent.length;
      while (taken.some(one => Math.abs(one.top - top) < 16 && left < one.left + one.width && one.left < left + width)) top += 4;
      taken.push({ left, top, width });
      shown.style.transform = `translate(${Math.min(left + 6, clientWidth - width).toFixed(1)}px, ${Math.min(top, clientHeight - 16).toFixed(1)}px)`;
    });
  }

  // -- what a person does -----------------------------------------------------------------------------

  down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
  }

  move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const [x, y] = [event.clientX - before[0], event.clientY - before[1]];
    const spread = () => {
      const [a, b] = [...this.pointers.values()];
      return Math.hypot(a[0] - b[0], a[1] - b[1]) || 1;
    };
    const was = this.pointers.size === 2 ? spread() : 0;
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (was) this.zoom(was / spread());
    else if (event.buttons & 2 || event.shiftKey) this.shift(x, y);
    else this.turn(-0.008 * x, 0.008 * y);
  }

  key(event) {
    const turns = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, 0.15], ArrowDown: [0, -0.15] };
    const zooms = { "+": 1 / 1.2, "-": 1.2 };
    if (event.ctrlKey || event.altKey || event.metaKey || !(event.key in turns || event.key in zooms)) return;
    event.preventDefault();
    if (event.key in turns) this.turn(...turns[event.key]);
    else this.zoom(zooms[event.key]);
  }

  turn(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.max(PITCH[0], Math.min(PITCH[1], this.pitch + pitch));
    this.touched = true;
    this.change();
  }

  zoom(factor) {
    this.distance = Math.max(0.2 * this.size, Math.min(20 * this.size, this.distance * factor));
    this.touched = true;
    this.change();
  }

  shift(x, y) {
    const scale = (2 * this.distance * Math.tan(LENS / 2)) / this.canvas.clientHeight;
    const [c, s] = [Math.cos(this.yaw), Math.sin(this.yaw)];
    this.target = [this.target[0] + s * x * scale, this.target[1] - c * x * scale, this.target[2] + y * scale];
    this.touched = true;
    this.change();
  }
}

// -- solids: the corners of their triangles, in their own frame -----------------------------------------

const fan = ring => ring.slice(2).flatMap((point, i) => [...ring[0], ...ring[i + 1], ...point]);
const wall = (lower, upper) => lower.flatMap((point, i) => {
  const k = (i + 1) % lower.length;
  return [...point, ...lower[k], ...upper[k], ...point, ...upper[k], ...upper[i]];
});
const prism = (height, ...foot) => {
  const ring = z => foot.flatMap((x, i) => (i % 2 ? [] : [[x, foot[i + 1], z]]));
  const [lower, upper] = [ring(0), ring(height)];
  return [...fan(lower), ...fan(upper), ...wall(lower, upper)];
};
const circle = (radius, z, sides = SIDES) => Array.from({ length: sides }, (_, i) => [radius * Math.cos((2 * Math.PI * i) / sides), radius * Math.sin((2 * Math.PI * i) / sides), z]);
const SOLIDS = {
  prism,
  box: (x, y, z) => prism(z, -x / 2, -y / 2, x / 2, -y / 2, x / 2, y / 2, -x / 2, y / 2).map((one, i) => (i % 3 === 2 ? one - z / 2 : one)),
  cylinder: (radius, length) => {
    const [lower, upper] = [circle(radius, -length / 2), circle(radius, length / 2)];
    return [...fan(lower), ...fan(upper), ...wall(lower, upper)];
  },
  sphere: radius => Array.from({ length: SIDES / 2 }, (_, i) => {
    const [a, b] = [i, i + 1].map(k => Math.PI * (k / (SIDES / 2) - 0.5));
    return wall(circle(radius * Math.cos(a), radius * Math.sin(a)), circle(radius * Math.cos(b), radius * Math.sin(b)));
  }).flat(),
};

// -- matrices, by columns, as WebGL has them ------------------------------------------------------------

const IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
const product = (a, b) => IDENTITY.map((_, i) => [0, 1, 2, 3].reduce((sum, k) => sum + a[4 * k + (i % 4)] * b[4 * (i >> 2) + k], 0));
const shifted = (x, y, z) => [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x, y, z, 1];
const scaled = (x, y, z) => [x, 0, 0, 0, 0, y, 0, 0, 0, 0, z, 0, 0, 0, 0, 1];
const moved4 = (m, [x, y, z]) => [0, 1, 2, 3].map(i => m[i] * x + m[4 + i] * y + m[8 + i] * z + m[12 + i]);
const moved3 = (m, point) => moved4(m, point).slice(0, 3);

// About an axis of length 1 (Rodrigues).
const turned = ([x, y, z], angle) => {
  const [c, s] = [Math.cos(angle), Math.sin(angle)], v = 1 - c;
  return [c + x * x * v, y * x * v + z * s, z * x * v - y * s, 0, x * y * v - z * s, c + y * y * v, z * y * v + x * s, 0,
    x * z * v + y * s, y * z * v - x * s, c + z * z * v, 0, 0, 0, 0, 1];
};

// A frame in another: x, y, z; roll, pitch, yaw about the fixed axes, in this order.
const placed = ([x, y, z, roll, pitch, yaw]) => product(shifted(x, y, z),
  product(turned([0, 0, 1], yaw), product(turned([0, 1, 0], pitch), turned([1, 0, 0], roll))));

// From a distance, at a point; at yaw 0 and pitch 0 from before it.
const looking = (at, yaw, pitch, distance) => {
  const [c, s, u, v] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
  const back = [u * c, u * s, v], right = [-s, c, 0], up = [-v * c, -v * s, u];
  const along = axis => -axis.reduce((sum, one, i) => sum + one * at[i], 0);
  return [right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0, along(right), along(up), along(back) - distance, 1];
};

const perspective = (aspect, near, far) => {
  const f = Math.min(1, aspect) / Math.tan(LENS / 2); // of the shorter side
  return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0];
};

const diagonal = (low, high) => Math.hypot(...high.map((one, i) => one - low[i]));
const rgb = text => [1, 3, 5].map(at => (parseInt(text.slice(at, at + 2), 16) || 0) / 255);
