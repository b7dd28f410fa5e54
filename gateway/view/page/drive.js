// Driving by hand: keys and a stick, as long as they are held.

import { $ } from "./elements.js";

const KEYS = {
  KeyW: [1, 0, 0], ArrowUp: [1, 0, 0], KeyS: [-1, 0, 0], ArrowDown: [-1, 0, 0],
  KeyA: [0, 1, 0], ArrowLeft: [0, 1, 0], KeyD: [0, -1, 0], ArrowRight: [0, -1, 0],
  KeyQ: [0, 0, 1], KeyE: [0, 0, -1],
}; // forward, to the left, sideways to the left
const TAKES_LETTERS = "input:not([type=range], [type=checkbox]), select";
const TAKES_ARROWS = `${TAKES_LETTERS}, [type=range], #log, #rows, .scroll, #figure-canvas`; // they move it, or scroll it

export class Drive {
  constructor(held) {
    Object.assign(this, { held, base: null, keys: new Set(), stick: [0, 0], pointer: null });
    const stick = $("stick");
    stick.addEventListener("pointerdown", event => this.grab(event));
    stick.addEventListener("contextmenu", event => event.preventDefault());
    stick.addEventListener("pointermove", event => event.pointerId === this.pointer && this.drag(event));
    for (const type of ["pointerup", "pointercancel", "lostpointercapture"])
      stick.addEventListener(type, event => event.pointerId === this.pointer && this.letGo());
    window.addEventListener("keydown", event => this.key(event, true));
    window.addEventListener("keyup", event => this.key(event, false));
    $("speed").addEventListener("input", () => ($("share").textContent = `${$("speed").value} %`));
  }

  // `base`: of hello, or null where there is nothing to drive.
  enable(base) {
    this.held.end();
    this.base = base;
    $("drive").hidden = !base;
    $("sideways").hidden = $("qe").hidden = !base?.max_lateral;
  }

  key(event, down) {
    if (!this.base || !(event.code in KEYS)) return;
    if (!down) {
      if (this.keys.delete(event.code)) this.change();
      return;
    }
    const taken = event.target.matches?.(event.code.startsWith("Arrow") ? TAKES_ARROWS : TAKES_LETTERS);
    if (taken || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    if (event.repeat || (KEYS[event.code][2] && !this.base.max_lateral)) return;
    this.keys.add(event.code);
    this.change();
  }

  grab(event) {
    if (this.pointer !== null || event.button !== 0) return;
    event.currentTarget.setPointerCapture((this.pointer = event.pointerId));
    this.drag(event);
    this.change();
  }

  drag(event) {
    const box = $("stick").getBoundingClientRect();
    const radius = box.width / 2;
    let x = (event.clientX - box.left - radius) / (radius * 0.75);
    let y = (event.clientY - box.top - radius) / (radius * 0.75);
    const length = Math.max(1, Math.hypot(x, y));
    [x, y] = [x / length, y / length];
    this.stick = [-y, -x].map(v => (Math.abs(v) < 0.08 ? 0 : v));
    $("knob").style.transform = `translate(${x * radius * 0.75}px, ${y * radius * 0.75}px)`;
  }

  letGo() {
    this.pointer = null;
    this.stick = [0, 0];
    $("knob").style.transform = "";
    this.change();
  }

  change() {
    if (!this.keys.size && this.pointer === null) this.held.end();
    else if (!this.active) {
      this.active = true;
      this.held.begin(() => this.line(), () => this.ended());
    } else this.held.repeat();
  }

  // Whatever ended it: what is still pressed must be pressed anew.
  ended() {
    this.active = false;
    this.keys.clear();
    this.stick = [0, 0];
    this.pointer = null;
    $("knob").style.transform = $("wanted").textContent = "";
  }

  line() {
    const sum = [this.stick[0], this.stick[1], 0];
    if ($("strafe").checked) [sum[1], sum[2]] = [0, sum[1]];
    for (const code of this.keys) KEYS[code].forEach((v, i) => (sum[i] += v));
    const { max_linear, max_angular, max_lateral, turning_radius } = this.base;
    const [x, turn, y] = sum.map(v => (Math.max(-1, Math.min(1, v)) * $("speed").value) / 100 + 0); // no -0
    const linear = x * max_linear;
    const angular = turning_radius ? (sum[1] * linear) / turning_radius : turn * max_angular;
    const lateral = y * max_lateral;
    $("wanted").textContent = `${linear.toFixed(2)} m/s  ${angular.toFixed(2)} rad/s` +
      (max_lateral ? `  ${lateral.toFixed(2)} m/s` : "");
    return `drive ${linear.toFixed(3)} ${angular.toFixed(3)}` + (max_lateral ? ` ${lateral.toFixed(3)}` : "");
  }
}
