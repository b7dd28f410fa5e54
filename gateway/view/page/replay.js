// A recording: played, paused, stepped, sought, with what differs from today's code.

import { $, button, make, say } from "./elements.js";

const RATES = [0.1, 0.25, 0.5, 1, 2, 5, 10];

const describe = ({ t, kind, text }) => `${t.toFixed(3)} s, ${kind}: ${text}`;

export class Replay {
  constructor(wire) {
    Object.assign(this, { wire, playback: null, sliding: false, marks: "" });
    $("rate").append(...RATES.map(rate => make("option", { value: rate, textContent: `× ${rate}`, selected: rate === 1 })));
    $("play").addEventListener("click", () => this.toggle());
    $("back").addEventListener("click", () => this.play({ step: -1 }));
    $("forth").addEventListener("click", () => this.play({ step: 1 }));
    $("first").addEventListener("click", () => $("marks").firstChild.click());
    $("rate").addEventListener("change", () => this.play({ rate: Number($("rate").value) }));
    $("seek").addEventListener("input", () => (this.sliding = true));
    $("seek").addEventListener("change", () => {
      this.sliding = false;
      this.play({ seek: Number($("seek").value) });
    });
  }

  play(asked) {
    this.wire.send({ play: asked });
  }

  toggle() {
    this.play({ playing: !this.playback?.playing });
  }

  take(playback) {
    this.playback = playback;
    const { playing, rate, t, length, prepared, differences, under_way } = playback;
    say($("play"), playing ? "Pause" : "Play");
    if (document.activeElement !== $("rate")) $("rate").value = rate;
    $("seek").max = length;
    if (!this.sliding) $("seek").value = t;
    say($("when"), `${t.toFixed(2)} of ${length.toFixed(2)} s${under_way ? " …" : ""}`);
    const found = differences.length;
    say($("prepared"), `${Math.floor(100 * prepared)} % compared, ${found || "no"} difference${found === 1 ? "" : "s"}`);
    $("ready").style.width = `${100 * prepared}%`;
    const marks = JSON.stringify([length, differences]);
    if (marks === this.marks) return;
    this.marks = marks;
    $("marks").replaceChildren(...differences.map(one => this.mark(one, length)));
    $("first").hidden = !differences.length;
    say($("difference"), differences.length ? describe(differences[0]) : "");
  }

  mark({ t, kind, text }, length) {
    const what = describe({ t, kind, text });
    const mark = button("", () => {
      this.play({ seek: t });
      say($("difference"), what);
    }, { title: what, ariaLabel: `difference: ${what}` });
    mark.style.left = `${(100 * t) / (length || 1)}%`;
    return mark;
  }
}
