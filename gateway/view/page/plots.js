// One plot of whatever signals are chosen, each tick of them: followed, paused, zoomed, with a cursor, and as CSV.

import { $, button, clock, make, number, setText } from "./elements.js";

const KEPT = 300; // s of what is plotted
const RECENT = 60; // s of every joint's row, from which a signal that is added has its past
const GAP = 1; // s without a value that are drawn as such
const MOST = 24; // signals
const LEAST = 0.02; // above and below what is plotted, of its unit
const AXES = 2; // units that have an axis; the others have their own scale and none
const FEW = 2; // joints whose velocity is plotted unasked
const IN_ROWS = { position: 4, velocity: 5, torque: 6, current: 7, voltage: 8, temperature: 9, age: 10 };
const COLOURS = 8; // of the style sheet; what is more is dashed
const key = (joint, quantity) => JSON.stringify([joint, quantity]);

export class Plots {
  constructor(wire) {
    Object.assign(this, { wire, id: 0, robot: "", joints: [], units: {}, signals: [], times: [], recent: [], paused: null, plot: null, changed: () => {}, lost: 0 });
    $("span").addEventListener("change", () => this.follow());
    $("pause").addEventListener("click", () => (this.paused ? this.follow() : this.pause()));
    $("csv").addEventListener("click", () => this.save());
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.build());
    new ResizeObserver(() => this.plot?.setSize(this.size())).observe($("plot"));
  }

  // Plot another robot: the wheels' or the first joints' velocities, until something else is chosen.
  reset({ robot, joints, quantities }) {
    const names = joints.map(joint => joint.name);
    const same = robot === this.robot && JSON.stringify(names) === JSON.stringify(this.joints);
    Object.assign(this, { robot, joints: names, units: quantities ?? {}, times: [], recent: [], lost: 0 });
    const chosen = same ? this.signals.map(({ joint, quantity }) => [joint, quantity])
      : names.slice(0, FEW).flatMap(name => [[name, "velocity command"], [name, "velocity"]]);
    this.signals = [];
    for (const [joint, quantity] of chosen) if (quantity in this.units) this.add(joint, quantity);
    this.follow();
    this.choose();
  }

  colour(joint, quantity) {
    return this.signals.find(one => one.key === key(joint, quantity))?.colour;
  }

  toggle(joint, quantity) {
    const at = this.signals.findIndex(one => one.key === key(joint, quantity));
    if (at >= 0) this.signals.splice(at, 1);
    else if (this.signals.length < MOST) this.add(joint, quantity);
    this.choose();
  }

  // Plot these quantities of a joint, too.
  show(joint, ...quantities) {
    for (const quantity of quantities) if (!this.colour(joint, quantity)) this.toggle(joint, quantity);
  }

  get now() {
    return this.times.at(-1) ?? 0;
  }

  // The times from one to another, and the values of these quantities of a joint then: a list each.
  between(from, to, joint, ...quantities) {
    const first = this.times.findIndex(t => t >= from), end = this.times.findIndex(t => t > to);
    const cut = list => (first < 0 || !list ? [] : list.slice(first, end < 0 ? undefined : end));
    const of = quantity => this.signals.find(one => one.key === key(joint, quantity))?.values;
    return [this.times, ...quantities.map(of)].map(cut);
  }

  // Add a signal, with what the rows of the last minute say of its past.
  add(joint, quantity) {
    const taken = this.signals.map(one => one.number);
    let number = 0;
    while (taken.includes(number)) number++;
    const [row, at] = [this.joints.indexOf(joint), IN_ROWS[quantity]];
    let i = -1;
    const values = this.times.map(t => {
      while (i + 1 < this.recent.length && this.recent[i + 1].t <= t) i++;
      return i < 0 || at === undefined || t - this.recent[i].t > GAP ? null : this.recent[i].rows[row]?.[at] ?? null;
    });
    this.signals.push({ key: key(joint, quantity), joint, quantity, number, colour: `var(--plot-${number % COLOURS})`, unit: this.units[quantity], values });
  }

  choose() {
    if (this.signals.length || this.id) this.wire.send({ plot: { id: ++this.id, signals: this.signals.map(({ joint, quantity }) => [joint, quantity]) } });
    this.build();
    this.changed();
  }

  // -- what comes ---------------------------------------------------------------------------------

  takeRows({ t, rows }) {
    while (this.recent.length && (this.recent.at(-1).t >= t || this.recent[0].t < t - RECENT)) this.recent.at(-1).t >= t ? this.recent.pop() : this.recent.shift();
    this.recent.push({ t, rows });
    if (!this.signals.length) this.row(t, []);
  }

  takeSignals({ id, rows, t, lost = 0 }, { buffer, offset }) {
    if (id !== this.id || !rows) return;
    this.lost += lost;
    const width = this.signals.length + 1;
    const data = new Float32Array(buffer, offset, rows * width);
    for (let at = 0; at < data.length; at += width) this.row(t + data[at], data.subarray(at + 1, at + width));
    this.draw();
  }

  row(t, values) {
    const { times } = this;
    let kept = times.length; // what is later is not true any more after a jump back in a recording
    while (kept && times[kept - 1] >= t) kept--;
    const columns = [times, ...this.signals.map(one => one.values)];
    if (kept < times.length) for (const list of columns) list.length = kept;
    if (times[0] < t - 1.1 * KEPT) {
      const old = times.findIndex(each => each >= t - KEPT);
      for (const list of columns) list.splice(0, old);
    }
    if (t - times.at(-1) > GAP) { // a jump, or silence: no line over it
      times.push((times.at(-1) + t) / 2);
      for (const { values: list } of this.signals) list.push(null);
    }
    times.push(t);
    this.signals.forEach((one, i) => one.values.push(Number.isNaN(values[i]) ? null : values[i]));
  }

  // -- what is seen -------------------------------------------------------------------------------

  follow() {
    this.range(null);
  }

  pause() {
    this.range([this.now - this.span, this.now]);
  }

  // Stand at a range of times, or follow: null.
  range(paused) {
    this.paused = paused;
    setText($("pause"), paused ? "Follow" : "Pause");
    $("pause").setAttribute("aria-pressed", Boolean(paused));
    this.draw();
  }

  get span() {
    return Number($("span").value);
  }

  get seen() {
    return this.paused ?? [this.now - this.span, this.now];
  }

  size() {
    return { width: $("plot").clientWidth || 300, height: $("plot").clientHeight || 240 };
  }

  build() {
    this.plot?.destroy();
    const style = getComputedStyle(document.documentElement);
    const colour = name => style.getPropertyValue(name).trim();
    const axis = { stroke: colour("--dim"), grid: { stroke: colour("--line"), width: 1 }, ticks: { show: false }, font: "11px system-ui" };
    const digits = step => Math.max(0, Math.ceil(-Math.log10(step) - 1e-9));
    const units = [...new Set(this.signals.map(one => one.unit))];
    const range = (_, low, high) => {
      if (low === null) return [-1, 1];
      const pad = Math.max(LEAST, 0.02 * Math.max(Math.abs(low), Math.abs(high)), (high - low) * 0.08);
      return [low - pad, high + pad];
    };
    this.plot = new uPlot({
      ...this.size(), legend: { show: false }, padding: [8, units.length > 1 ? 0 : 14, 0, 0],
      cursor: { points: { show: false }, drag: { x: true, y: false, setScale: false } },
      scales: { x: { time: false, range: () => this.seen }, ...Object.fromEntries((units.length ? units : ["y"]).map(unit => [unit, { range }])) },
      axes: [{ ...axis, size: 22, values: (_, ticks, __, ___, step) => ticks.map(t => clock(t, digits(step))) },
        ...(units.length ? units : ["y"]).slice(0, AXES).map((unit, i) => ({ ...axis, scale: unit, size: 52, values: (_, ticks, __, ___, step) => ticks.map(v => v.toFixed(digits(step))), side: i ? 1 : 3, grid: i ? { show: false } : axis.grid }))],
      series: [{}, ...this.signals.map(({ number, unit, quantity }) => ({ scale: unit, stroke: colour(`--plot-${number % COLOURS}`), width: 1.5, points: { show: false },
        dash: number >= COLOURS ? [6, 4] : undefined, paths: quantity.endsWith("command") ? uPlot.paths.stepped({ align: 1 }) : undefined }))],
      hooks: {
        setCursor: [() => this.legend()],
        setSelect: [plot => {
          const { left, width } = plot.select;
          if (width < 4) return;
          plot.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
          this.range([plot.posToVal(left, "x"), plot.posToVal(left + width, "x")]);
        }],
        ready: [plot => plot.over.addEventListener("dblclick", () => this.follow())],
      },
    }, this.data(), $("plot"));
    setText($("plot-unit"), units.slice(0, AXES).join(", right: "));
    $("signals").replaceChildren(...this.signals.map(one => {
      const value = make("span", { className: "num" });
      one.shown = value;
      const name = make("span", { textContent: `${one.joint} ${one.quantity} ` });
      const item = button("", () => this.toggle(one.joint, one.quantity), { className: "signal", title: "take it off the plot" });
      item.style.setProperty("--of", one.colour);
      item.append(name, value, ` ${one.unit} ×`);
      return item;
    }));
    $("no-signals").hidden = this.signals.length > 0;
    this.legend();
  }

  data() {
    return [this.times, ...this.signals.map(one => one.values)];
  }

  // With the next frame, once for all that has come.
  draw() {
    this.frame ??= requestAnimationFrame(() => {
      this.frame = null;
      if (!this.plot) return;
      this.plot.setData(this.data());
      this.legend();
    });
  }

  // The values at the cursor, else the newest.
  legend() {
    const at = this.plot?.cursor.idx ?? this.times.length - 1;
    for (const { shown, values, unit } of this.signals) setText(shown, number(values[at], unit === "ms" || unit === "°C" ? 0 : 3));
    setText($("plot-time"), this.times.length ? clock(this.times[at], 2) : "");
    setText($("plot-lost"), this.lost ? `${this.lost} ticks were lost: the link is too slow` : "");
  }

  // Save what is seen as a file.
  save() {
    const [from, to] = this.seen;
    const quoted = text => `"${text.replaceAll('"', '""')}"`;
    const lines = [["t [s]", ...this.signals.map(({ joint, quantity, unit }) => `${joint} ${quantity} [${unit}]`)].map(quoted).join(",")];
    this.times.forEach((t, i) => {
      if (t < from || t > to) return;
      const values = this.signals.map(one => one.values[i]);
      if (values.some(value => value !== null)) lines.push([t.toFixed(4), ...values.map(value => (value === null ? "" : Number(value.toPrecision(7))))].join(","));
    });
    const url = URL.createObjectURL(new Blob([lines.join("\r\n") + "\r\n"], { type: "text/csv" }));
    make("a", { href: url, download: `${this.robot.replace(/[^\w-]+/g, "_")}.csv` }).click();
    setTimeout(() => URL.revokeObjectURL(url), 10000);
  }
}
