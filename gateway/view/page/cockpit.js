// The cockpit: what comes over the wire is handed to its panels, what a person does becomes lines of the operator's
// language. The page knows nothing that the robot did not setText, and sends nothing that nobody did, but which signals it plots.

import { Cameras } from "./camera.js";
import { Drive } from "./drive.js";
import { $, number, setText, twice } from "./elements.js";
import { Figure } from "./figure.js";
import { Joints } from "./joints.js";
import { Field } from "./map.js";
import { log, rewind, Settings, showBuses, showFaults, showMission, showSystems } from "./panels.js";
import { Plots } from "./plots.js";
import { Replay } from "./replay.js";
import { Held, Wire } from "./wire.js";

const query = new URLSearchParams(location.search);
const on = { hello, settings, note, state, answer, joints: rows, signals: (m, b) => plots.takeSignals(m, b), path: (m, b) => field.takePath(m, b),
  scan: (m, b) => field.takeScan(m, b), tiles: (m, b) => field.takeTiles(m, b), mesh: (m, b) => figure.takeMesh(m, b),
  camera: m => cameras.take(m), picture: (m, b) => cameras.takePicture(m, b) };
const wire = new Wire(query.get("scene") === "2" ? "/cockpit/2" : "/cockpit", on, lost);
const held = new Held(wire, refused);
const drive = new Drive(held);
const field = new Field((x, y, yaw) =>
  ask(`goal ${x.toFixed(3)} ${y.toFixed(3)}` + (yaw === null ? "" : ` ${((yaw * 180) / Math.PI).toFixed(1)}`)));
const plots = new Plots(wire);
const figure = new Figure();
const cameras = new Cameras();
const joints = new Joints(wire, held, plots);
$("both").search = location.search;
const table = new Settings(wire);
const replay = new Replay(wire);
let robot = null;
let steer = false;

// -- in -------------------------------------------------------------------------------------------

function hello(message) {
  robot = message;
  const live = message.mode === "live";
  steer = live && message.steer;
  document.title = `${message.robot} – cockpit`;
  setText($("robot"), message.robot);
  setText($("mode"), live ? (steer ? "live" : "live, read-only") : message.mode);
  const { base } = message;
  document.body.classList.toggle("bare", !base);
  $("map").hidden = !base;
  $("replay").hidden = message.mode !== "replay";
  $("stopping").hidden = !live;
  $("record").hidden = $("mission-buttons").hidden = $("drop").hidden = !steer;
  $("ask").hidden = !live;
  setText($("hint"), !steer ? "Drag to move the map." : matchMedia("(pointer: coarse)").matches
    ? "After the flag, tap: goal; drag: goal with heading. Else one finger moves the map, two zoom."
    : "Click: goal. Drag: goal with heading. Right button: move the map.");
  $("aim").hidden = !steer;
  field.steer = steer;
  field.reset(base?.outline ?? [], message.walls ?? []);
  figure.reset(message);
  cameras.reset();
  joints.reset(message, steer);
  plots.reset(message);
  drive.enable(steer ? base : null);
  table.reset(steer);
  $("log").replaceChildren();
}

function settings(message) {
  table.take(message);
}

function rows(message) {
  joints.take(message);
  plots.takeRows(message);
  figure.take(message.figure);
}

function note(message) {
  log(message.level, message.text, message.source, message.t);
  table.note(message);
}

function answer({ ok, text, held: ofHeld }) {
  log(ok ? "answer" : "refused", text);
  if (ofHeld && !ok) {
    held.end();
    refused(text);
  }
  if (ok && text.includes("\n")) return;
  setText($("answer"), text);
  $("answer").className = ok ? "" : "bad";
}

function state(message) {
  if (!robot) return;
  const stopped = message.stop || message.stopped;
  if (stopped) held.end();
  const word = stopped ? "stopped" : message.state;
  setText($("word"), word);
  $("word").dataset.state = word;
  setText($("reason"), message.stopped || message.reason);
  $("stop").classList.toggle("pressed", message.stop);
  $("release").hidden = !(message.stop && steer);
  showSystems(message.systems);
  showMission(message.mission);
  showFaults(message.faults, steer && (name => ask(`clear ${name}`)));
  showBuses(robot, message);
  if (message.playback) {
    replay.take(message.playback);
    rewind(message.t);
    setText($("answer"), message.recording);
  }
  $("both").hidden = !(message.recordings > 1) || query.has("scene");
  if (!robot.base) return;
  field.take(message);
  const [x, y, yaw] = message.pose ?? [];
  const [linear, , lateral] = message.twist ?? [];
  const speed = message.twist ? `  ${number(lateral ? Math.hypot(linear, lateral) : linear, 2, "m/s")}` : "";
  setText($("pose"), message.pose ? `x ${number(x, 2)}  y ${number(y, 2)}  ${number((yaw * 180) / Math.PI, 0)}°${speed}` : "no pose yet");
}

function refused(why) {
  if (!wire.why) banner(why);
}

function banner(why) {
  setText($("banner"), why);
  $("banner").hidden = !why;
}

function lost(why, open) {
  held.end();
  banner(why);
  document.body.classList.toggle("lost", Boolean(why));
  $("stop").disabled = Boolean(why) && !open;
  setText($("stop-how"), $("stop").disabled ? "not connected" : "space bar");
  if (why) $("release").hidden = true;
  $("main").inert = $("replay").inert = Boolean(why) && !open;
  if (!why) return;
  setText($("word"), open ? "silent" : "not connected");
  delete $("word").dataset.state;
}

// -- out ------------------------------------------------------------------------------------------

function ask(line) {
  wire.ask(line);
}

function stop() {
  ask("stop an operator pressed STOP");
  held.end();
}

$("stop").addEventListener("pointerdown", event => event.button === 0 && stop()); // not when it is let go
$("stop").addEventListener("click", event => event.detail === 0 && stop()); // by Enter, or a screen reader
twice($("release"), () => ask("release"));
for (const type of ["keydown", "keyup"])
  window.addEventListener(type, event => {
    const text = event.target === $("line") && $("line").value; // the command line needs spaces between its words
    if (event.code !== "Space" || text) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    if (type === "keyup" || event.repeat || !robot) return;
    if (robot.mode === "live") stop();
    else if (robot.mode === "replay") replay.toggle();
  }, true);

// STOP stands above a keyboard on the screen, and within what is seen of a page that is zoomed.
for (const type of ["resize", "scroll"])
  visualViewport.addEventListener(type, () => {
    const covered = document.documentElement.clientHeight - visualViewport.offsetTop - visualViewport.height;
    $("stopping").style.setProperty("--covered", `${Math.max(0, covered)}px`);
  });

$("drop").addEventListener("click", () => ask("drop"));
$("clear").addEventListener("click", () => ask("clear all"));
$("mission-buttons").addEventListener("click", event => event.target.dataset.ask && ask(event.target.dataset.ask));
$("record").addEventListener("click", () => wire.send({ record: $("record").getAttribute("aria-pressed") !== "true" }));

const lines = [];
let at = 0;
$("ask").addEventListener("submit", event => {
  event.preventDefault();
  const line = $("line").value.trim();
  if (!line) return;
  lines.push(line);
  at = lines.length;
  $("line").value = "";
  log("asked", line);
  ask(line);
});
$("line").addEventListener("keydown", event => {
  if (event.key !== "ArrowUp" && event.key !== "ArrowDown") return;
  event.preventDefault();
  at = Math.max(0, Math.min(lines.length, at + (event.key === "ArrowUp" ? -1 : 1)));
  $("line").value = lines[at] ?? "";
});
