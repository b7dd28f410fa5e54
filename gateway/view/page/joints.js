// The joints: a row each, whose values are plotted by a click; below it what more there is of a joint, and what moves it.

import { $, button, holdable, make, number, setText, twice } from "./elements.js";
import { figures, inWords } from "./steps.js";

const PLOTTED = { Velocity: "velocity", Position: "position", Impedance: "position", Torque: "torque" };
const CONTROLLED = [["position", 4, 3], ["velocity", 5, 2], ["torque", 6, 3]];
const COLUMNS = [...CONTROLLED, ["temperature", 9, 0], ["age", 10, 0]]; // quantity, where it is in a row, digits
const MORE = [["current", 7, 2], ["voltage", 8, 1]];
const FAULTS = 11;
const SHARE = 0.1; // of a limit, with which a joint is moved unless another value is typed
const REST = 500; // ms at 0 before a step
const ANSWER = 2000; // ms that a step of position is looked at
const SEEN = 0.3; // s before and after a step that are plotted with it
const LONG = 9999; // ms, from which an age is only said to be long

export class Joints {
  // `plots`: what a click on a value plots.
  constructor(wire, held, plots) {
    Object.assign(this, { wire, held, plots, rows: [], steer: false, measured: new Map() }); // of each joint, what is controlled
    plots.changed = () => this.press();
  }

  // Show the joints of a robot; `steer`: whether those that are bare can be moved.
  reset({ joints, quantities }, steer) {
    Object.assign(this, { steer, units: quantities ?? {} });
    this.rows = joints.map(joint => this.row(joint, steer && joint.moves === "joint"));
    for (const [id, quantity] of COLUMNS.map(([name]) => [`u-${name}`, name])) setText($(id), this.units[quantity] ?? "");
    $("joints").replaceChildren(...this.rows.flatMap(row => [row.element, row.more]));
  }

  row(joint, move) {
    const { name } = joint;
    const values = new Map();
    const value = (quantity, label = "") => {
      const shown = make("span", { className: "num", textContent: "–" });
      const one = button("", () => this.plots.toggle(name, quantity), { className: "value", title: `plot ${quantity} of ${name}` });
      one.append(label, shown);
      values.set(quantity, { button: one, shown });
      return one;
    };
    const open = button(name, () => {
      more.hidden = !more.hidden;
      open.setAttribute("aria-expanded", !more.hidden);
    }, { className: "open", title: `more of ${name}` });
    open.setAttribute("aria-expanded", false);
    const mode = make("span", { className: "chip" });
    const command = button("", () => this.plots.toggle(name, `${command.quantity} command`), { className: "value", quantity: "velocity", title: `plot the command of ${name}` });
    command.append(make("span", { className: "num", textContent: "–" }), make("small"));
    const fault = make("td");
    const element = make("tr", { className: "joint" }, make("td", {}, make("div", {}, open, mode)), make("td", {}, command),
      ...COLUMNS.map(([quantity]) => make("td", {}, value(quantity))), fault);
    const others = Object.keys(this.units).filter(one => !COLUMNS.some(([quantity]) => quantity === one));
    const cell = make("td", { colSpan: element.children.length }, make("p", { className: "dim", textContent: `${joint.protocol}, ${joint.bus} ${joint.address}` }),
      make("div", { className: "row" }, ...others.map(quantity => value(quantity, `${quantity} `))));
    if (move) cell.append(this.controls(joint));
    if (this.steer) cell.append(this.parameters(joint));
    const more = make("tr", { className: "more", hidden: true }, cell);
    return { name, element, more, mode, command, fault, values, clear: null };
  }

  // What moves a bare joint: as long as a button is held, to a position, and where it is.
  controls({ name, commands, requests, limits }) {
    const box = make("div", { className: "row controls" });
    const shown = make("output", { ariaLive: "polite", className: "wide" });
    const ask = line => this.wire.ask(`${line} ${name}`);
    const turned = ["Velocity", "Torque"].filter(kind => commands.includes(kind));
    if (turned.length) {
      const kind = make("select", { ariaLabel: `what is commanded of ${name}` }, ...turned.map(one => make("option", { value: one.toLowerCase(), textContent: `${one.toLowerCase()} [${this.units[one.toLowerCase()] ?? ""}]` })));
      const size = make("input", { type: "number", min: 0, step: "any", required: true, ariaLabel: `with how much ${name} is moved` });
      const rest = () => {
        const most = limits[kind.value];
        Object.assign(size, { value: Number((SHARE * most).toPrecision(3)), max: most });
      };
      kind.addEventListener("change", rest);
      rest();
      // `share` of what is typed when it is pressed, by the time [ms] since. `begun` and `ended`: of a test, which is looked at.
      const hold = (text, title, share, begun = () => {}, ended = () => {}) => {
        const one = button(text, null, { className: "hold", title });
        let holding = false;
        holdable(one, () => {
          if (holding || !size.reportValidity()) return; // by a second finger, or by Enter
          holding = true;
          one.classList.add("held");
          const [what, most, since] = [kind.value, Number(size.value), performance.now()];
          begun(what);
          this.held.begin(() => `${what} ${name} ${share(performance.now() - since) * most}`, () => {
            holding = false;
            one.classList.remove("held");
            ended(what);
          });
        }, () => holding && this.held.end());
        return one;
      };
      let test = null;
      const title = "as long as it is held";
      box.append(make("span", { className: "inline" }, kind, size), hold("− hold", title, () => -1), hold("hold +", title, () => 1),
        hold("hold: step", `0 for ${REST / 1000} s, then this, as long as it is held; it is plotted, and its figures are shown`,
          ms => (ms < REST ? 0 : 1), what => (test = this.begin(name, what)), () => this.end(test, shown)));
    }
    if (commands.includes("Position")) {
      const input = make("input", { type: "number", step: "any", required: true, ariaLabel: `position of ${name} [rad]`, placeholder: "rad", className: "to" });
      const form = make("form", { className: "inline" }, input, make("button", { textContent: "Go to" }));
      form.addEventListener("submit", event => {
        event.preventDefault();
        this.wire.ask(`position ${name} ${input.value}`);
      });
      const by = button("Step by", () => {
        const from = this.measured.get(name)?.[0];
        if (!form.reportValidity() || from === undefined || from === null) return;
        const test = this.begin(name, "position");
        this.wire.ask(`position ${name} ${(from + Number(input.value)).toFixed(5)}`);
        setTimeout(() => this.end(test, shown), ANSWER);
      }, { title: "so much from where it is; it is plotted, and its figures are shown" });
      form.append(by);
      box.append(form);
    }
    for (const command of ["Hold", "Idle"])
      if (commands.includes(command)) box.append(button(command, () => ask(command.toLowerCase())));
    for (const request of ["Home", "Zero"])
      if (requests.includes(request)) box.append(twice(button(`${request} …`), () => ask(request.toLowerCase())));
    box.append(shown);
    return box;
  }

  // A step that is looked at: plotted from now on,
  begin(name, quantity) {
    this.plots.show(name, `${quantity} command`, quantity);
    this.plots.follow();
    return { name, quantity, from: this.plots.now };
  }

  // and what it was like, once the last of it has come.
  end({ name, quantity, from }, shown) {
    const to = this.plots.now;
    setTimeout(() => {
      const found = figures(...this.plots.between(from, to, name, `${quantity} command`, quantity));
      setText(shown, `${quantity} step: ${inWords(found, this.units[quantity] ?? "")}`);
      this.plots.range([from - SEEN, to + SEEN]);
    }, 1000 * SEEN);
  }

  // The device's own parameters, its gains among them, by its own names: read, and written when pressed twice.
  parameters({ name, requests, parameters }) {
    const box = make("form", { className: "row parameters" });
    if (!requests.includes("ReadParameter")) return box;
    const list = make("datalist", { id: `parameters of ${name}` }, ...(parameters ?? []).map(value => make("option", { value })));
    const which = make("input", { required: true, maxLength: 200, placeholder: "parameter", spellcheck: false, ariaLabel: `a parameter of ${name}` });
    which.setAttribute("list", list.id);
    box.append(list, which, make("button", { textContent: "Read" }));
    box.addEventListener("submit", event => {
      event.preventDefault();
      this.wire.ask(`read ${name} ${which.value.trim()}`);
    });
    if (!requests.includes("WriteParameter")) return box;
    const value = make("input", { type: "number", step: "any", placeholder: "value", ariaLabel: `its value for ${name}` });
    box.append(value, twice(button("Write …"), () =>
      which.reportValidity() && value.value && this.wire.ask(`write ${name} ${which.value.trim()} ${value.value}`)));
    return box;
  }

  take({ rows }) {
    this.rows.forEach((row, i) => {
      if (!rows[i]) return;
      this.measured.set(row.name, CONTROLLED.map(([, at]) => rows[i][at]));
      this.show(row, rows[i]);
    });
  }

  show({ name, mode, command, fault, values }, row) {
    const [state, armed, kind, wanted] = row;
    setText(mode, armed && state !== "armed" ? `${state}, armed` : state);
    mode.dataset.state = state;
    const quantity = PLOTTED[kind];
    if (quantity && quantity !== command.quantity) {
      command.quantity = quantity;
      this.press();
    }
    setText(command.firstChild, quantity ? number(wanted, 2) : kind || "–");
    setText(command.lastChild, quantity ? ` ${this.units[quantity] ?? ""}` : "");
    const put = (quantity, text) => values.has(quantity) && setText(values.get(quantity).shown, text);
    for (const [quantity, at, digits] of [...COLUMNS, ...MORE])
      put(quantity, quantity === "age" && row[at] > LONG ? "long" : number(row[at], digits));
    for (const [of, at, digits] of CONTROLLED) {
      const known = of === quantity && wanted !== null;
      put(`${of} command`, number(known ? wanted : null, digits));
      put(`${of} error`, number(known && row[at] !== null ? wanted - row[at] : null, digits));
    }
    const faults = row[FAULTS];
    if (fault.faults === faults && fault.steer === this.steer) return;
    Object.assign(fault, { faults, steer: this.steer });
    fault.replaceChildren(...(!faults ? [] : this.steer ? [button("Clear", () => this.wire.ask(`clear ${name}`), { ariaLabel: `clear the faults of ${name}` })]
      : [make("b", { className: "bad", textContent: `${faults}` })]));
  }

  // Show which values are plotted, with their colours.
  press() {
    for (const { name, command, values } of this.rows) {
      const shown = [[command, `${command.quantity} command`], ...[...values].map(([quantity, { button }]) => [button, quantity])];
      for (const [one, quantity] of shown) {
        const colour = this.plots.colour(name, quantity);
        one.setAttribute("aria-pressed", Boolean(colour));
        one.style.setProperty("--of", colour ?? "");
      }
    }
  }
}
