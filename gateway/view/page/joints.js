// The joints: values, the last 20 s of command and feedback, and how bare joints are moved by hand.

import { $, button, holdable, make, number, setText, twice } from "./elements.js";

const SPAN = 20; // s
const GAP = 1; // s without a value that are drawn as such
const PERIOD = 90; // ms between two drawings
const QUANTITIES = { position: 4, velocity: 5, torque: 6 }; // where they are in a row
const UNITS = { position: "rad", velocity: "rad/s", torque: "N·m" };
const PLOTTED = { Velocity: "velocity", Position: "position", Impedance: "position", Torque: "torque" };
const VALUES = [["velocity", 5, 2, "rad/s"], ["position", 4, 3, "rad"], ["torque", 6, 3, "N·m"], ["current", 7, 2, "A"],
  ["voltage", 8, 1, "V"], ["temperature", 9, 1, "°C"]];

export class Joints {
  constructor(wire, held) {
    Object.assign(this, { wire, held, cards: [], times: [], drawn: 0 });
    $("quantity").addEventListener("change", () => this.draw());
    $("jog").addEventListener("input", () => setText($("jog-share"), `${$("jog").value} %`));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
    this.seen = new IntersectionObserver(entries => {
      for (const entry of entries) this.cards[entry.target.dataset.row].visible = entry.isIntersecting;
    });
  }

  // Show the joints of a robot; `steer`: whether those that are bare can be moved.
  reset(joints, steer) {
    this.seen.disconnect();
    for (const card of this.cards) card.plot.destroy();
    Object.assign(this, { times: [], steer });
    const bare = joints.some(joint => joint.moves === "joint");
    $("jogging").hidden = !(steer && bare);
    this.cards = joints.map((joint, row) => this.card(joint, row, steer && joint.moves === "joint"));
    $("joints").replaceChildren(...this.cards.map(card => card.element));
    for (const card of this.cards) this.seen.observe(card.element);
  }

  card(joint, row, move) {
    const mode = make("span", { className: "chip" });
    const clear = button("Clear faults", () => this.wire.ask(`clear ${joint.name}`), { hidden: true });
    const values = {};
    const list = make("dl", { className: "facts" });
    for (const name of ["command", ...VALUES.map(([name]) => name), "feedback"]) {
      values[name] = make("dd", { className: "num", textContent: "–" });
      list.append(make("div", {}, make("dt", { textContent: name }), values[name]));
    }
    const box = make("div", { className: "plot" });
    const element = make("article", { className: "joint" },
      make("div", { className: "row" }, make("h3", { textContent: joint.name }), mode,
        make("span", { className: "dim", textContent: `${joint.protocol}, ${joint.bus} ${joint.address}` }), clear),
      list, box);
    element.dataset.row = row;
    if (move) element.append(this.controls(joint));
    const card = { element, mode, clear, values, box, rows: [], visible: true, plot: null };
    card.plot = this.plot(box);
    new ResizeObserver(() => card.plot.setSize({ width: box.clientWidth, height: 110 })).observe(box);
    return card;
  }

  controls({ name, commands, requests, limits }) {
    const box = make("div", { className: "row controls" });
    const ask = line => this.wire.ask(`${line} ${name}`);
    if (commands.includes("Velocity"))
      for (const [text, sign] of [["− jog", -1], ["jog +", 1]]) {
        const one = button(text, null, { className: "hold", title: "as long as it is held" });
        const line = () => `velocity ${name} ${((sign * limits.velocity * $("jog").value) / 100).toFixed(4)}`;
        let holding = false;
        holdable(one, () => {
          if (holding) return; // by a second finger, or by Enter
          holding = true;
          one.classList.add("held");
          this.held.begin(line, () => {
            holding = false;
            one.classList.remove("held");
          });
        }, () => holding && this.held.end());
        box.append(one);
      }
    if (commands.includes("Position")) {
      const input = make("input", { type: "number", step: "any", required: true, ariaLabel: `position of ${name} [rad]`, placeholder: "rad" });
      const form = make("form", { className: "inline" }, input, make("button", { textContent: "Go to" }));
      form.addEventListener("submit", event => {
        event.preventDefault();
        this.wire.ask(`position ${name} ${input.value}`);
      });
      box.append(form);
    }
    for (const command of ["Hold", "Idle"])
      if (commands.includes(command)) box.append(button(command, () => ask(command.toLowerCase())));
    for (const request of ["Home", "Zero"])
      if (requests.includes(request)) box.append(twice(button(`${request} …`), () => ask(request.toLowerCase())));
    return box;
  }

  plot(box) {
    const colour = name => () => getComputedStyle(document.documentElement).getPropertyValue(name);
    const axis = { stroke: colour("--dim"), grid: { stroke: colour("--line"), width: 1 }, ticks: { show: false }, font: "11px system-ui" };
    const range = (_, low, high) => {
      if (low === null) return [-1, 1];
      const pad = Math.max(0.1, (high - low) * 0.1);
      return [low - pad, high + pad];
    };
    return new uPlot({
      width: box.clientWidth || 300, height: 110, legend: { show: false }, cursor: { show: false }, padding: [6, 14, 0, 0],
      scales: { x: { time: false, range: () => [-SPAN, 0] }, y: { range } },
      axes: [{ ...axis, size: 22, values: (_, ticks) => ticks.map(v => `${v} s`) }, { ...axis, size: 46 }],
      series: [{}, { stroke: colour("--command"), width: 2, paths: uPlot.paths.stepped({ align: 1 }), points: { show: false } },
        { stroke: colour("--feedback"), width: 1.5, points: { show: false } }],
    }, [[], [], []], box);
  }

  take({ t, rows }) {
    const { times } = this;
    let kept = times.length; // what is later is not true any more after a jump back in a recording
    while (kept && times[kept - 1] >= t) kept--;
    const old = times[0] < t - SPAN - 2 ? times.filter(each => each < t - SPAN).length : 0;
    for (const list of [times, ...this.cards.map(card => card.rows)]) {
      list.length = kept;
      list.splice(0, old);
    }
    const before = times.at(-1);
    if (t - before > GAP) { // a jump, or silence: no line over it
      times.push((before + t) / 2);
      for (const { rows } of this.cards) rows.push([]);
    }
    times.push(t);
    this.cards.forEach((card, i) => card.rows.push(rows[i]));
    const now = performance.now();
    if (now - this.drawn < PERIOD) return;
    this.drawn = now;
    this.frame ??= requestAnimationFrame(() => {
      this.frame = null;
      this.draw();
    });
  }

  draw() {
    const { times } = this;
    if (!times.length) return;
    const name = $("quantity").value;
    const x = times.map(t => t - times[times.length - 1]);
    for (const card of this.cards) {
      if (!card.rows.length) continue;
      this.show(card, card.rows[card.rows.length - 1]);
      if (!card.visible) continue;
      const command = card.rows.map(row => (PLOTTED[row[2]] === name ? row[3] : null));
      card.plot.setData([x, command, card.rows.map(row => row[QUANTITIES[name]] ?? null)]);
    }
  }

  show({ mode, clear, values }, row) {
    const [state, armed, kind, value] = row;
    setText(mode, armed && state !== "armed" ? `${state}, armed` : state);
    mode.dataset.state = state;
    const quantity = PLOTTED[kind];
    setText(values.command.previousSibling, quantity ? `→ ${kind}` : "command");
    setText(values.command, quantity ? number(value, 2, UNITS[quantity]) : kind || "–");
    for (const [name, at, digits, unit] of VALUES) setText(values[name], number(row[at], digits, unit));
    setText(values.feedback, row[10] === null ? "none yet" : row[10] > 9999 ? "long ago" : `${row[10]} ms ago`);
    clear.hidden = !(row[11] && this.steer);
  }
}
