// Draws the plots of a report, and the robot on its map at the time under the cursor.
// Texts of the data get into the page as text only.
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const place = document.getElementById("plots");
  const drawn = new Map(); // element -> plot
  const OPEN = 12; // plots that are drawn at once; the groups behind them open at a click
  const HEIGHT = 190;
  const FONT = "12px system-ui, sans-serif";
  const COLOURS = { commanded: "--planned", measured: "--believed", believed: "--believed", true: "--true" };
  const OTHERS = ["--believed", "--planned", "--true", "--wall", "--raw"];
  let zooming = false;

  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  function element(kind, text, parent) {
    const made = document.createElement(kind);
    made.textContent = text;
    parent.append(made);
    return made;
  }

  function zoomAll(from) {
    if (zooming) return;
    zooming = true;
    const { min, max } = from.scales.x;
    for (const one of drawn.values()) if (one !== from) one.setScale("x", { min, max });
    zooming = false;
  }

  function draw(plot, into) {
    const axis = { stroke: colour("--soft"), font: FONT, grid: { stroke: colour("--grid"), width: 1 },
      ticks: { show: false } };
    const series = plot.lines.map((line, i) => ({
      label: line.name,
      stroke: colour(COLOURS[line.name] || OTHERS[i % OTHERS.length]),
      width: 1.3,
      dash: line.name === "commanded" ? [6, 3] : undefined,
      spanGaps: line.name !== "commanded",
      points: { show: false },
      value: (_, value) => (value == null ? "–" : String(value)),
    }));
    const made = new uPlot({
      width: into.clientWidth,
      height: HEIGHT,
      scales: { x: { time: false } },
      axes: [{ ...axis, size: 34, values: (_, ticks) => ticks.map((t) => t + " s") }, { ...axis, size: 58, values: (_, ticks) => ticks.map((v) => String(+v.toPrecision(6))) }],
      series: [{ label: "t", value: (_, t) => (t == null ? "–" : t + " s") }, ...series],
      cursor: { sync: { key: "time" }, points: { size: 5 } },
      legend: { markers: { dash: (u, i) => (u.series[i].dash ? "dashed" : "solid") } },
      hooks: { setScale: [(u, key) => key === "x" && zoomAll(u)], setCursor: [(u) => show(u.data[0][u.cursor.idx])] },
    }, [data.times, ...plot.lines.map((line) => line.values)], into);
    const other = [...drawn.values()][0];
    drawn.set(into, made);
    if (other) made.setScale("x", { min: other.scales.x.min, max: other.scales.x.max });
  }

  function fill(group, into) {
    for (const plot of group.plots) {
      const box = element("div", "", into);
      element("h3", `${plot.title} [${plot.unit}]`, box);
      const canvas = element("div", "", box);
      canvas.plot = plot;
      draw(plot, canvas);
      resized.observe(canvas);
    }
  }

  const resized = new ResizeObserver((entries) => {
    for (const { target } of entries) {
      const one = drawn.get(target);
      if (one && target.clientWidth && one.width !== target.clientWidth) {
        one.setSize({ width: target.clientWidth, height: HEIGHT });
      }
    }
  });

  let shown = 0;
  for (const group of data.groups) {
    const details = element("details", "", place);
    element("summary", group.name, details);
    const into = element("div", "", details);
    into.className = "plots";
    details.addEventListener("toggle", () => {
      if (details.open && !into.hasChildNodes()) fill(group, into);
    });
    details.open = shown === 0 || shown + group.plots.length <= OPEN;
    shown += group.plots.length;
  }

  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    for (const [canvas, old] of [...drawn]) {
      draw(canvas.plot, canvas); // zoomed as the old one
      old.destroy();
    }
  });

  // -- the map: the robot at a time; the wheel zooms, dragging moves, a double click shows all again. While the
  // cursor is over a plot and the map is out of sight, a small one stands beside.

  const map = document.getElementById("map");
  const robot = document.getElementById("robot");

  function show(time) {
    if (!robot || time == null) return;
    const later = data.poses.findIndex((pose) => pose[0] > time);
    const pose = data.poses[later < 0 ? data.poses.length - 1 : Math.max(later - 1, 0)];
    robot.setAttribute("transform", `translate(${pose[1]} ${-pose[2]}) rotate(${-pose[3]})`);
    robot.style.visibility = "visible";
  }

  if (map) {
    const SVG = "http://www.w3.org/2000/svg";
    const beside = document.body.appendChild(document.createElementNS(SVG, "svg"));
    beside.id = "beside";
    beside.setAttribute("viewBox", map.getAttribute("viewBox"));
    beside.appendChild(document.createElementNS(SVG, "use")).setAttribute("href", "#world");
    let inSight = true;
    new IntersectionObserver((entries) => { inSight = entries[0].isIntersecting; }).observe(map);
    place.addEventListener("pointermove", (event) => {
      const shown = !inSight && event.target.closest(".u-over");
      beside.style.visibility = shown ? "visible" : "hidden";
    });
    place.addEventListener("pointerleave", () => { beside.style.visibility = "hidden"; });

    const box = map.viewBox.baseVal;
    const whole = [box.x, box.y, box.width, box.height];
    const set = (x, y, width, height) => map.setAttribute("viewBox", [x, y, width, height].join(" "));
    const at = (event) => new DOMPoint(event.clientX, event.clientY).matrixTransform(map.getScreenCTM().inverse());
    let held = null;
    map.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !event.shiftKey) return; // the page scrolls
      event.preventDefault();
      const scale = Math.exp((event.deltaY || event.deltaX) / 400);
      const point = at(event);
      set(point.x + (box.x - point.x) * scale, point.y + (box.y - point.y) * scale, box.width * scale, box.height * scale);
    }, { passive: false });
    map.addEventListener("pointerdown", (event) => { if (event.pointerType === "mouse") held = at(event); });
    map.addEventListener("pointermove", (event) => {
      if (!held) return;
      const point = at(event);
      set(box.x + held.x - point.x, box.y + held.y - point.y, box.width, box.height);
    });
    addEventListener("pointerup", () => { held = null; });
    map.addEventListener("dblclick", () => set(...whole));
  }
})();
