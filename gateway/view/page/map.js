// The map: what the robot believes of the place, drawn when something has changed. Metres; y to the left of x.

import { $, Drawing } from "./elements.js";

const SIGMA_95 = Math.sqrt(5.991); // 95 % of a normal distribution in the plane (chi-square, 2 degrees of freedom)
const TRAIL = 6000; // points of the path driven
const STEP = 0.03; // m between two of them
const SEEN = 60; // of a cell's -127 to 127: certain enough for the full colour
const CLICK = 8; // pixels: less is no drag
const OLD = 2; // s: a scan that is older is not drawn
const COLOURS = ["unknown", "free", "wall", "grid", "robot", "path", "trail", "raw", "scan", "goal"];

export class Field extends Drawing {
  // `setGoal` takes x, y and yaw (or null) of a goal that was clicked.
  constructor(setGoal) {
    super();
    Object.assign(this, { setGoal, canvas: $("canvas"), pen: $("canvas").getContext("2d"), steer: false });
    Object.assign(this, { x: 0, y: 0, scale: 60, follow: true, pointers: new Map(), aim: null, touchAims: false });
    this.reset([], []);
    new ResizeObserver(() => this.resize()).observe(this.canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.paint());
    this.paint();
    this.canvas.addEventListener("wheel", event => this.wheel(event), { passive: false });
    this.canvas.addEventListener("contextmenu", event => event.preventDefault());
    this.canvas.addEventListener("pointerdown", event => this.down(event));
    this.canvas.addEventListener("pointermove", event => this.move(event));
    this.canvas.addEventListener("pointerup", event => this.up(event, true));
    for (const type of ["pointercancel", "lostpointercapture"]) this.canvas.addEventListener(type, event => this.up(event, false));
    window.addEventListener("keydown", event => event.key === "Escape" && this.cancel());
    $("nearer").addEventListener("click", () => this.zoom(1.4));
    $("wider").addEventListener("click", () => this.zoom(1 / 1.4));
    $("follow").addEventListener("click", () => this.following(!this.follow));
    $("aim").addEventListener("click", () => this.aiming(!this.touchAims));
  }

  reset(outline, walls) {
    Object.assign(this, { outline, walls, tiles: new Map(), trail: [], rawTrail: [], path: [], scans: [], state: null });
    this.change();
  }

  // -- what is received -----------------------------------------------------------------------

  take(state) {
    const jumped = this.state && (state.t < this.state.t || state.t > this.state.t + 5); // in a recording
    if (jumped) [this.trail, this.rawTrail] = [[], []];
    if (state.pose) this.trail = append(this.trail, state.pose);
    if (state.raw) this.rawTrail = append(this.rawTrail, state.raw);
    this.state = state;
    this.change();
  }

  takePath(_, bytes) {
    this.path = new Float32Array(bytes.buffer, bytes.offset);
    this.change();
  }

  takeScan(header, { buffer, offset }) {
    this.scans = [];
    for (const lidar of header.lidars) {
      const ranges = new Float32Array(buffer, offset, lidar.count);
      offset += 4 * lidar.count;
      if (!lidar.poses.length) continue;
      const points = [];
      this.scans.push({ t: lidar.t, points });
      const [first, last] = lidar.poses; // the robot moves while the beam turns
      const turn = Math.atan2(Math.sin(last[2] - first[2]), Math.cos(last[2] - first[2]));
      ranges.forEach((range, i) => {
        if (!(range >= lidar.near && range < lidar.far)) return;
        const share = i / lidar.count;
        const yaw = first[2] + share * turn;
        const [c, s] = [Math.cos(yaw), Math.sin(yaw)];
        const angle = yaw + lidar.yaw + lidar.min + i * lidar.step;
        points.push(first[0] + share * (last[0] - first[0]) + c * lidar.x - s * lidar.y + range * Math.cos(angle),
          first[1] + share * (last[1] - first[1]) + s * lidar.x + c * lidar.y + range * Math.sin(angle));
      });
    }
    this.change();
  }

  takeTiles(header, { buffer, offset }) {
    if (header.reset) this.tiles.clear();
    const { size, resolution, corner } = header;
    for (const [row, column] of header.keys) {
      const cells = new Int8Array(buffer, offset, size * size);
      offset += size * size;
      const tile = { cells: cells.slice(), size, side: size * resolution };
      tile.x = corner[0] + column * tile.side;
      tile.y = corner[1] + row * tile.side;
      this.render(tile);
      this.tiles.set(`${row},${column}`, tile);
    }
    this.change();
  }

  // -- drawing --------------------------------------------------------------------------------

  paint() {
    const style = getComputedStyle(document.documentElement);
    this.colour = Object.fromEntries(COLOURS.map(name => [name, style.getPropertyValue(`--map-${name}`).trim()]));
    for (const tile of this.tiles.values()) this.render(tile);
    this.change();
  }

  // A tile as a picture, its first row at the bottom.
  render(tile) {
    const { size, cells } = tile;
    tile.picture ??= Object.assign(document.createElement("canvas"), { width: size, height: size });
    const pen = tile.picture.getContext("2d");
    const picture = pen.createImageData(size, size);
    const [free, wall] = [rgb(this.colour.free), rgb(this.colour.wall)];
    for (let i = 0; i < cells.length; i++) {
      if (!cells[i]) continue;
      const at = 4 * ((size - 1 - Math.floor(i / size)) * size + (i % size));
      picture.data.set(cells[i] > 0 ? wall : free, at);
      picture.data[at + 3] = Math.min(255, 60 + (195 * Math.abs(cells[i])) / SEEN);
    }
    pen.putImageData(picture, 0, 0);
  }

  draw() {
    const { pen, state, colour } = this;
    if (!this.width) return;
    if (this.ratio !== window.devicePixelRatio) return this.resize(); // the window was moved to another screen
    if (this.follow && state?.pose && !this.aim) [this.x, this.y] = state.pose;
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.fillStyle = colour.unknown;
    pen.fillRect(0, 0, this.canvas.width, this.canvas.height);
    const k = this.scale * this.ratio;
    const [cx, cy] = [this.canvas.width / 2 - this.x * k, this.canvas.height / 2 + this.y * k];
    pen.setTransform(k, 0, 0, -k, cx, cy); // metres from here on
    this.pixel = 1 / this.scale;
    pen.imageSmoothingEnabled = false;
    for (const tile of this.tiles.values()) {
      pen.save();
      pen.translate(tile.x, tile.y + tile.side);
      pen.scale(1, -1);
      pen.drawImage(tile.picture, 0, 0, tile.side, tile.side);
      pen.restore();
    }
    this.drawGrid();
    pen.fillStyle = colour.wall;
    for (const wall of this.walls) {
      pen.beginPath();
      for (const corner of wall) pen.lineTo(...corner);
      pen.fill();
    }
    this.line(this.rawTrail, colour.raw, 1, [4, 4]);
    this.line(this.path, colour.path, 4);
    this.line(this.trail, colour.trail, 2);
    pen.fillStyle = colour.scan;
    const dot = 2.5 * this.pixel;
    for (const { t, points } of this.scans)
      for (let i = 0; i < points.length && !(Math.abs(state?.t - t) > OLD); i += 2)
        pen.fillRect(points[i] - dot / 2, points[i + 1] - dot / 2, dot, dot);
    if (state?.goal) this.drawGoal(...state.goal);
    if (state?.pose) this.drawRobot(state.pose, state.covariance);
    if (this.aim) this.drawGoal(this.aim.x, this.aim.y, this.aim.yaw);
    this.drawScale();
  }

  drawGrid() {
    const { pen, pixel } = this;
    const step = this.grid();
    const [w, h] = [this.width / 2 * pixel, this.height / 2 * pixel];
    pen.beginPath();
    for (let x = Math.ceil((this.x - w) / step) * step; x < this.x + w; x += step) {
      pen.moveTo(x, this.y - h);
      pen.lineTo(x, this.y + h);
    }
    for (let y = Math.ceil((this.y - h) / step) * step; y < this.y + h; y += step) {
      pen.moveTo(this.x - w, y);
      pen.lineTo(this.x + w, y);
    }
    this.stroke(this.colour.grid, 1);
  }

  // m between two lines of the grid: 1, 2 or 5 times a power of ten, at least 50 pixels.
  grid() {
    const least = 50 / this.scale;
    const power = 10 ** Math.floor(Math.log10(least));
    return [1, 2, 5, 10].map(m => m * power).find(step => step >= least);
  }

  drawScale() {
    const { pen, ratio } = this;
    const length = this.grid();
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.fillStyle = this.colour.unknown + "cc";
    pen.fillRect(6, this.height - 34, Math.max(44, 12 + length * this.scale), 28);
    pen.fillStyle = pen.strokeStyle = this.colour.robot;
    pen.lineWidth = 2;
    pen.beginPath();
    pen.moveTo(12, this.height - 12);
    pen.lineTo(12 + length * this.scale, this.height - 12);
    pen.stroke();
    pen.font = "12px system-ui, sans-serif";
    pen.fillText(length < 1 ? `${Math.round(length * 100)} cm` : `${length} m`, 12, this.height - 18);
  }

  drawRobot([x, y, yaw], covariance) {
    const { pen, colour } = this;
    pen.save();
    pen.translate(x, y);
    if (covariance) this.drawEllipse(covariance, yaw);
    pen.rotate(yaw);
    pen.beginPath();
    for (const corner of this.outline) pen.lineTo(...corner);
    pen.closePath();
    pen.fillStyle = colour.robot + "55";
    pen.fill();
    this.stroke(colour.robot, 2);
    const reach = Math.max(10 * this.pixel, ...this.outline.map(corner => corner[0]));
    pen.beginPath(); // where its front is
    pen.moveTo(reach, 0);
    pen.lineTo(reach * 0.3, reach * 0.35);
    pen.lineTo(reach * 0.3, -reach * 0.35);
    pen.fillStyle = colour.robot;
    pen.fill();
    pen.restore();
  }

  // Where it is, and where it looks, with 95 %.
  drawEllipse([xx, xy, , , yy, , , , aa], yaw) {
    const { pen, colour } = this;
    const [mean, half] = [(xx + yy) / 2, Math.hypot((xx - yy) / 2, xy)];
    const radius = v => Math.max(1.5 * this.pixel, SIGMA_95 * Math.sqrt(Math.max(0, v)));
    pen.beginPath();
    pen.ellipse(0, 0, radius(mean + half), radius(mean - half), Math.atan2(2 * xy, xx - yy) / 2, 0, 2 * Math.PI);
    pen.fillStyle = colour.goal + "33";
    pen.fill();
    this.stroke(colour.goal, 1.5);
    const spread = Math.min(Math.PI, 1.96 * Math.sqrt(Math.max(0, aa)));
    pen.beginPath();
    pen.moveTo(0, 0);
    pen.arc(0, 0, 36 * this.pixel, yaw - spread, yaw + spread);
    pen.closePath();
    pen.fill();
  }

  drawGoal(x, y, yaw) {
    const { pen, pixel, colour } = this;
    pen.save();
    pen.translate(x, y);
    pen.beginPath();
    pen.arc(0, 0, 9 * pixel, 0, 2 * Math.PI);
    pen.moveTo(3 * pixel, 0);
    pen.arc(0, 0, 3 * pixel, 0, 2 * Math.PI);
    if (yaw !== null && yaw !== undefined) {
      pen.rotate(yaw);
      pen.moveTo(9 * pixel, 0);
      pen.lineTo(34 * pixel, 0);
      pen.lineTo(26 * pixel, 6 * pixel);
      pen.moveTo(34 * pixel, 0);
      pen.lineTo(26 * pixel, -6 * pixel);
    }
    this.stroke(colour.goal, 3);
    pen.restore();
  }

  line(points, colour, width, dash = []) {
    const { pen } = this;
    if (points.length < 4) return;
    pen.beginPath();
    for (let i = 0; i < points.length; i += 2) pen.lineTo(points[i], points[i + 1]);
    pen.setLineDash(dash.map(v => v * this.pixel));
    this.stroke(colour, width);
    pen.setLineDash([]);
  }

  stroke(colour, width) {
    this.pen.strokeStyle = colour;
    this.pen.lineWidth = width * this.pixel;
    this.pen.lineJoin = "round";
    this.pen.stroke();
  }

  // -- looking around, and goals --------------------------------------------------------------

  // Where a pointer is: m.
  at(event) {
    const box = this.canvas.getBoundingClientRect();
    return {
      x: this.x + (event.clientX - box.left - this.width / 2) / this.scale,
      y: this.y - (event.clientY - box.top - this.height / 2) / this.scale,
    };
  }

  zoom(factor, event) {
    const scale = Math.min(1000, Math.max(4, this.scale * factor));
    if (event && !this.follow) { // what is below the pointer stays there
      const { x, y } = this.at(event);
      this.x = x + ((this.x - x) * this.scale) / scale;
      this.y = y + ((this.y - y) * this.scale) / scale;
    }
    this.scale = scale;
    this.change();
  }

  following(on) {
    this.follow = on;
    $("follow").setAttribute("aria-pressed", on);
    this.change();
  }

  // Whether the next finger sets a goal: others move the map.
  aiming(on) {
    this.touchAims = on;
    $("aim").setAttribute("aria-pressed", on);
  }

  wheel(event) {
    event.preventDefault();
    this.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), event);
  }

  down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, event);
    this.aim = null;
    if (this.pointers.size === 1 && event.button === 0 && this.steer && (event.pointerType !== "touch" || this.touchAims))
      this.aim = { ...this.at(event), yaw: null, from: event };
    this.change();
  }

  move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    if (this.aim) {
      const { from, x, y } = this.aim;
      const to = this.at(event);
      const far = Math.hypot(event.clientX - from.clientX, event.clientY - from.clientY) > CLICK;
      this.aim.yaw = far ? Math.atan2(to.y - y, to.x - x) : null;
    } else {
      const others = [...this.pointers.values()].filter(one => one.pointerId !== event.pointerId);
      this.pan((event.clientX - before.clientX) / (others.length + 1), (event.clientY - before.clientY) / (others.length + 1));
      if (others.length === 1) {
        const span = one => Math.max(10, Math.hypot(one.clientX - others[0].clientX, one.clientY - others[0].clientY));
        const [clientX, clientY] = [(event.clientX + others[0].clientX) / 2, (event.clientY + others[0].clientY) / 2];
        this.zoom(span(event) / span(before), { clientX, clientY });
      }
    }
    this.pointers.set(event.pointerId, event);
    this.change();
  }

  pan(dx, dy) {
    if (dx || dy) this.following(false);
    this.x -= dx / this.scale;
    this.y += dy / this.scale;
  }

  up(event, done) {
    this.pointers.delete(event.pointerId);
    const aim = this.aim;
    this.cancel();
    if (!aim || !done) return;
    this.aiming(false);
    this.setGoal(aim.x, aim.y, aim.yaw);
  }

  cancel() {
    this.aim = null;
    this.change();
  }
}

function append(trail, [x, y]) {
  const n = trail.length;
  if (n && Math.hypot(x - trail[n - 2], y - trail[n - 1]) < STEP) return trail;
  trail.push(x, y);
  return n > 2 * TRAIL ? trail.slice(TRAIL) : trail;
}

function rgb(hex) {
  return [1, 3, 5].map(i => parseInt(hex.slice(i, i + 2), 16));
}
