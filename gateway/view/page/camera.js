// What cameras see: their markers, by bearing and rise as in an image, and behind them the image where there is one.

import { $, make, number, setText } from "./elements.js";

const WIDE = 0.7, TALL = 0.53; // tangents of half the view where no image says them
const EDGE = 1.05; // of what is seen, beyond a marker
const OF = 0.25; // s: a marker belongs to an image that is no farther from it

export class Cameras {
  constructor() {
    this.shown = new Map();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.shown.forEach(one => this.draw(one)));
  }

  reset() {
    this.shown.clear();
    $("cameras").replaceChildren();
    $("camera-panel").hidden = true;
  }

  camera(name) {
    if (!this.shown.has(name)) {
      const canvas = make("canvas", { width: 640, height: 480, role: "img", ariaLabel: `what ${name} sees` }), text = make("p", { className: "num dim" });
      $("cameras").append(make("h3", { textContent: name }), canvas, text);
      $("camera-panel").hidden = false;
      this.shown.set(name, { canvas, text, seen: [], image: null, wide: WIDE, tall: TALL });
    }
    return this.shown.get(name);
  }

  take({ t, cameras }) {
    for (const { name, seen } of cameras) this.draw(Object.assign(this.camera(name), { seen, t }));
  }

  async takePicture({ name, t, wide, tall }, { buffer, offset }) {
    const image = await createImageBitmap(new Blob([new Uint8Array(buffer, offset)], { type: "image/jpeg" }));
    const one = this.camera(name);
    one.image?.close();
    this.draw(Object.assign(one, { image, at: t, wide, tall }));
  }

  draw({ canvas, text, seen, image, at, wide, tall, t }) {
    // Of each marker what is nearest in time to the image; without one, to what was reported last. They come one by one.
    const when = image ? at : Math.max(...seen.map(one => one.t)), off = one => Math.abs(one.t - when);
    const best = new Map();
    for (const one of seen) if (one.at && off(one) < OF && !(off(best.get(one.marker) ?? { t: Infinity }) <= off(one))) best.set(one.marker, one);
    const markers = [...best.values()];
    if (!image) { // nothing says how wide it sees: as wide as what it has seen
      const more = Math.max(1, ...markers.map(({ at: [x, y] }) => EDGE * Math.max(Math.abs(x) / wide, Math.abs(y) / tall)));
      [wide, tall] = [wide * more, tall * more];
    }
    const { width, height } = canvas, pen = canvas.getContext("2d");
    const style = getComputedStyle(document.documentElement), colour = name => style.getPropertyValue(name).trim();
    const place = ([left, up]) => [(1 - left / wide) * width / 2, (1 - up / tall) * height / 2];
    pen.fillStyle = colour("--map-unknown");
    pen.fillRect(0, 0, width, height);
    if (image) pen.drawImage(image, 0, 0, width, height);
    pen.strokeStyle = colour("--line");
    for (const [from, to] of [[[wide, 0], [-wide, 0]], [[0, tall], [0, -tall]]]) line(pen, place(from), place(to), 1);
    pen.font = "bold 20px system-ui";
    for (const { marker, at: to, face, distance } of markers) {
      const [x, y] = place(to), name = `${marker}  ${number(distance, 2, "m")}`;
      pen.fillStyle = "#ffd400";
      for (const [shade, thick] of [["#000", 7], ["#ffd400", 3]]) { // seen on whatever is behind
        pen.strokeStyle = shade;
        line(pen, [x, y], face ? place(face) : [x, y], thick);
        pen.strokeRect(x - 9, y - 9, 18, 18);
        if (shade === "#000") pen.strokeText(name, x + 14, y - 12);
      }
      pen.fillText(name, x + 14, y - 12);
    }
    const shown = markers.map(({ marker, distance }) => `${marker} at ${number(distance, 2, "m")}`).join(", ");
    setText(text, t === undefined ? "" : !seen.length ? "no image reported for 2 s" : shown || "no marker");
  }
}

function line(pen, from, to, thick) {
  pen.lineWidth = thick;
  pen.beginPath();
  pen.moveTo(...from);
  pen.lineTo(...to);
  pen.stroke();
}
