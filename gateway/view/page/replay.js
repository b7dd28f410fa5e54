// A recording: played, paused, stepped, sought, with what differs from today's code.

import { $, button, make, setText } from "./elements.js";

const RATES = [0.1, 0.25, 0.5, 1, 2, 5, 10];
const KEPT = 3; // states, 100 ms each, until what was sought is in them

const describe = ({ t, kind, text }) => `${t.toFixed(3)} s, ${kind}: ${text}`;

export class Replay {
  constructor(wire) {
    Object.assign(this, { wire, playback: null, kept: 0, marks: "" });
    $("rate").append(...RATES.map(rate => make("option", { value: rate, textContent: `× ${rate}`, selected: rate === 1 })));
    $("play").addEventListener("click", () => this.toggle());
    $("back").addEventListener("click", () => this.play({ step: -1 }));
    $("forth").addEventListener("click", () => this.play({ step: 1 }));
    $("first").addEventListener("click", () => $("marks").firstChild.click());
    $("rate").addEventListener("change", () => this.play({ rate: Number($("rate").value) }));
    $("seek").addEventListener("input", () => (this.kept = Infinity));
    $("seek").addEventListener("change", () => this.seek($("seek").value));
    for (const type of ["pointerup", "pointercancel"]) // without a change, if it is where it was before
      $("seek").addEventListener(type, () => (this.kept = Math.min(this.kept, KEPT)));
    $("seek").addEventListener("keydown", event => {
      const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (!by || event.altKey || event.ctrlKey || event.metaKey) return;
      event.preventDefault();
      this.seek(Number($("seek").value) + by);
    });
  }

  play(asked) {
    this.wire.send({ play: asked });
  }

  seek(t) {
    $("seek").value = t;
    this.kept = KEPT;
    this.play({ seek: Number($("seek").value) });
  }

  toggle() {
    this.play({ playing: !this.playback?.playing });
  }

  take(playback) {
    this.playback = playback;
    const { playing, rate, t, due, length, prepared, differences, under_way } = playback;
    setText($("play"), playing ? "Pause" : "Play");
    if (document.activeElement !== $("rate")) $("rate").value = rate;
    $("seek").max = length;
    if (this.kept) this.kept--;
    else $("seek").value = under_way ? due : t;
    const when = `${t.toFixed(2)} of ${length.toFixed(2)} s${under_way ? " …" : ""}`;
    setText($("when"), when);
    $("seek").setAttribute("aria-valuetext", when);
    const found = differences.length;
    setText($("prepared"), `${Math.floor(100 * prepared)} % compared, ${found || "no"} difference${found === 1 ? "" : "s"}`);
    $("ready").style.width = `${100 * prepared}%`;
    const marks = JSON.stringify([length, differences]);
    if (marks === this.marks) return;
    this.marks = marks;
    $("marks").replaceChildren(...differences.map(one => this.mark(one, length)));
    $("first").hidden = !differences.length;
    setText($("difference"), differences.length ? describe(differences[0]) : "");
  }

  mark({ t, kind, text }, length) {
    const what = describe({ t, kind, text });
    const mark = button("", () => {
      this.seek(t);
      setText($("difference"), what);
    }, { title: what, ariaLabel: `difference: ${what}` });
    mark.style.left = `${(100 * t) / (length || 1)}%`;
    return mark;
  }
}
