// What the robot reports of itself: the three systems, the mission, faults, buses, settings and the log.

import { $, button, clock, make, number, setText } from "./elements.js";

const KEPT = 300; // lines of the log
const MARKS = { info: "i", warning: "! warning", error: "✖ error", asked: "›", answer: "=", refused: "✖ refused" };

// -- state ----------------------------------------------------------------------------------------

export function showSystems(systems) {
  rows($("systems"), systems, name => make("div", {}, make("dt", { textContent: name }), make("dd", {},
    make("span", { className: "chip" }), " ", make("span"))), (row, [, state, reason]) => {
    const [chip, why] = row.querySelectorAll("span");
    setText(chip, state);
    chip.dataset.state = state;
    setText(why, reason);
  });
}

export function showMission(mission) {
  $("mission").hidden = !mission;
  if (!mission) return;
  setText($("mission-name"), mission.name);
  setText($("mission-phase"), mission.phase);
  $("mission-phase").dataset.state = mission.phase;
  const step = mission.step ? `step ${mission.step} of ${mission.steps}: ${mission.text}` : `${mission.steps} steps`;
  setText($("mission-step"), mission.reason ? `${step} (${mission.reason})` : step);
}

let shown = "";
export function showFaults(faults, clear) {
  const all = JSON.stringify([faults, Boolean(clear)]);
  if (all === shown) return;
  shown = all;
  $("clear").hidden = !clear || !faults.length;
  $("to-faults").hidden = !faults.length;
  setText($("to-faults"), `${faults.length} fault${faults.length > 1 ? "s" : ""}`);
  $("faults").replaceChildren(...faults.map(fault => {
    const code = fault.code > 0 ? `0x${fault.code.toString(16)}` : `${fault.code}`;
    const element = make("article", { className: "fault" },
      make("h3", { textContent: `${fault.joint}: ${fault.name} ` }, make("small", { textContent: code })),
      make("p", {}, make("b", { textContent: "Likely cause: " }), fault.cause || "unknown"),
      make("p", {}, make("b", { textContent: "What to do: " }), fault.remedy || "clear it"));
    if (clear) element.append(button(`Clear ${fault.joint}`, () => clear(fault.joint)));
    return element;
  }), ...(faults.length ? [] : [make("p", { className: "dim", textContent: "none" })]));
}

export function showBuses(hello, state) {
  const list = hello.buses.flatMap(bus => {
    const counted = (state.received ?? []).filter(one => one.bus === bus.name);
    const load = state.load?.[bus.name];
    return (counted.length ? counted : [{}]).map((one, i) => [`${bus.name} ${one.protocol}`, i ? "" : bus.name, i ? null : load, one, bus]);
  });
  rows($("buses"), list, () => make("tr", {}, ...Array.from("12345", () => make("td", { className: "num" }))), (row, [, name, load, one, bus]) => {
    const cells = row.children;
    if (cells[0].className) {
      cells[0].className = "";
      cells[0].append(make("div", { textContent: name }), make("small", { className: "dim" }));
      cells[0].title = `${bus.kind}, ${bus.interface}${bus.bitrate ? `, ${bus.bitrate / 1e6} Mbit/s` : ""}`;
      if (name) cells[1].append(make("span"), make("meter", { min: 0, max: 1, high: 0.7, optimum: 0, ariaLabel: `load of ${name}` }));
    }
    const trouble = name && !["up", "back", undefined].includes(state.bus_states?.[name]);
    setText(cells[0].lastChild, (one.protocol ?? bus.kind) + (trouble ? `, ${state.bus_states[name]}` : ""));
    cells[0].lastChild.className = trouble ? "bad" : "dim";
    if (name) {
      cells[1].lastChild.value = load ?? 0;
      setText(cells[1].firstChild, load === undefined ? "–" : `${(100 * load).toFixed(1)} %`);
    }
    ["accepted", "malformed", "ignored"].forEach((key, i) => setText(cells[i + 2], `${one[key] ?? "–"}`));
    cells[3].classList.toggle("bad", one.malformed > 0);
  });
  setText($("ticks"), `${state.ticks ?? "–"}`);
  setText($("sent"), `${state.sent ?? "–"}`);
  setText($("missed"), `${state.missed ?? "–"}`);
  setText($("longest"), number(state.longest, 2, "ms"));
  setText($("timing"), state.timing === undefined ? "–" : state.timing || "in time");
  $("timing").classList.toggle("bad", Boolean(state.timing));
  $("pace").hidden = !(state.pace < 0.9);
  setText($("pace"), `slow motion: ${number(state.pace, 2)} of real time`);
  setText($("recording"), state.trouble ? `${state.recording}: ${state.trouble}` : state.recording || "off");
  $("record").setAttribute("aria-pressed", Boolean(state.recording));
  setText($("record"), state.recording ? "Stop recording" : "Record");
}

// Keep one row per item, made by the item's first value, and filled by all of it.
function rows(parent, items, make, fill) {
  const keys = JSON.stringify(items.map(item => item[0]));
  if (parent.dataset.keys !== keys) {
    parent.dataset.keys = keys;
    parent.replaceChildren(...items.map(item => make(item[0])));
  }
  items.forEach((item, i) => fill(parent.children[i], item));
}

// -- log ------------------------------------------------------------------------------------------

export function log(level, text, source = "", t = null) {
  const list = $("log");
  const when = t === null ? "" : clock(t);
  list.prepend(make("li", { className: level, t },
    make("span", { className: "num dim", textContent: when }), " ",
    make("b", { textContent: `${MARKS[level] ?? level}${source ? ` ${source}:` : ""}` }), " ",
    make("span", { className: "text", textContent: text })));
  while (list.children.length > KEPT) list.lastChild.remove();
}

// Forget what has not happened yet, after a jump back in a recording.
export function rewind(t) {
  while ($("log").firstChild?.t > t) $("log").firstChild.remove();
}

// -- settings -------------------------------------------------------------------------------------

export class Settings {
  constructor(wire) {
    Object.assign(this, { wire, rows: new Map(), steer: false });
    $("filter").addEventListener("input", () => this.filter());
  }

  reset(steer) {
    this.steer = steer;
    this.rows.clear();
    $("rows").replaceChildren();
  }

  take({ rows }) {
    for (const row of rows) {
      if (!this.rows.has(row.key)) this.add(row);
      const { form, input, reset, file, edited } = this.rows.get(row.key);
      if (!edited()) input.value = input.defaultValue = short(row.value);
      form.classList.toggle("changed", row.value !== row.file);
      reset.hidden = row.value === row.file || !this.steer;
      setText(file, `robot file: ${short(row.file)}${bounds(row)}`);
    }
    this.filter();
  }

  add({ key, file: original, low, high }) {
    const input = make("input", { type: "number", step: "any", required: true, min: low === undefined ? "" : short(low), max: high === undefined ? "" : short(high), ariaLabel: key, readOnly: !this.steer });
    const set = make("button", { textContent: "Set", hidden: !this.steer });
    const reset = button("Reset", () => this.set(key, Number(original)), { title: "to the robot file's value" });
    const file = make("small", { className: "dim" });
    const answer = make("output", { ariaLive: "polite" });
    const form = make("form", {}, make("span", { className: "key", textContent: key }), input, set, reset, file, answer);
    form.addEventListener("submit", event => {
      event.preventDefault();
      this.set(key, input.value);
    });
    const edited = () => document.activeElement === input && input.value !== input.defaultValue;
    this.rows.set(key, { form, input, reset, file, answer, edited });
    $("rows").append(form);
  }

  set(key, value) {
    const { input, answer } = this.rows.get(key);
    input.defaultValue = input.value = value;
    answer.className = "";
    setText(answer, "…");
    this.wire.ask(`set ${key} ${value}`, ({ ok, text }) => {
      if (!ok) this.setText(key, text, "bad");
    });
  }

  // What became of it stands in a note of the robot's: "KEY = VALUE", or "set KEY: refused: why".
  note({ source, text }) {
    const [, key, ok, rest] = /^(?:set )?(\S+?)(?:( = )|: )(.*)$/s.exec(text) ?? [];
    if (source === "operator" && this.rows.has(key)) this.setText(key, ok ? `now ${rest}` : rest, ok ? "good" : "bad");
  }

  setText(key, text, tone) {
    const { answer } = this.rows.get(key);
    answer.className = tone;
    setText(answer, text);
  }

  filter() {
    const words = $("filter").value.toLowerCase().split(/[\s,]+/);
    let count = 0;
    for (const [key, { form }] of this.rows) {
      form.hidden = !words.every(word => key.toLowerCase().includes(word));
      count += !form.hidden;
    }
    setText($("count"), `${count} of ${this.rows.size}`);
  }
}

const short = value => `${Number(Number(value).toPrecision(6))}`;
const bounds = ({ low, high }) =>
  (low === undefined ? "" : `, at least ${short(low)}`) + (high === undefined ? "" : `, at most ${short(high)}`);
