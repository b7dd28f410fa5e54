// What makes elements. Text of the robot only ever becomes text: no markup is made of it.

export const $ = id => document.getElementById(id);

export function make(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

export function button(text, act, properties = {}) {
  const one = make("button", { type: "button", textContent: text, ...properties });
  if (act) one.addEventListener("click", act);
  return one;
}

// Set a text, only if it is another.
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export const number = (value, digits, unit = "") =>
  value === null || value === undefined ? "–" : `${value.toFixed(digits).replace(/^-(0\.?0*)$/, "$1")}${unit && " " + unit}`;

// A time in s as minutes and seconds.
export const clock = (t, digits = 2) => {
  const size = Number(Math.abs(t).toFixed(digits)), minutes = Math.floor(size / 60);
  return `${t < 0 ? "-" : ""}${minutes}:${(size - 60 * minutes).toFixed(digits).padStart(digits + (digits ? 3 : 2), "0")}`;
};

// Have a button act only if it is pressed twice within 3 s.
export function twice(button, act) {
  const text = button.textContent;
  let timer = 0;
  const rest = () => {
    clearTimeout(timer);
    timer = 0;
    button.textContent = text;
    button.classList.remove("sure");
  };
  button.addEventListener("click", () => {
    if (timer) {
      rest();
      act();
      return;
    }
    timer = setTimeout(rest, 3000);
    button.textContent = "Press again";
    button.classList.add("sure");
  });
  return button;
}

// Have a button held: by a pointer, or by Enter.
export function holdable(button, begin, end) {
  button.addEventListener("pointerdown", event => {
    if (event.button !== 0) return;
    button.setPointerCapture(event.pointerId);
    begin();
  });
  for (const type of ["pointerup", "pointercancel", "lostpointercapture", "blur"]) button.addEventListener(type, end);
  button.addEventListener("contextmenu", event => event.preventDefault());
  button.addEventListener("keydown", event => event.key === "Enter" && !event.repeat && begin());
  button.addEventListener("keyup", event => event.key === "Enter" && end());
}

// What is drawn on a canvas: in its own pixels, once a frame at most, when something has changed.
export class Drawing {
  resize() {
    const { clientWidth, clientHeight } = this.canvas, ratio = window.devicePixelRatio;
    Object.assign(this, { width: clientWidth, height: clientHeight, ratio });
    this.canvas.width = Math.round(clientWidth * ratio);
    this.canvas.height = Math.round(clientHeight * ratio);
    this.change();
  }

  change() {
    this.frame ??= requestAnimationFrame(() => {
      this.frame = null;
      this.draw();
    });
  }
}
