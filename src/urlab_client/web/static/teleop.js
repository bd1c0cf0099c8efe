// Moves a hand with keys or a gamepad: sends velocities to the console, which solves for the joints.

import { now, reset } from "./bar.js";
import { $, choices, h, heading, text } from "./dom.js";
import { ask, on, send } from "./link.js";

const PERIOD_MS = 20;
const DEAD = 0.15; // dead zone: a released stick may read this much
const SLOW = 0.2;

/** Index and sign of the velocity by `event.code`, which names the same physical keys on every keyboard layout. */
const KEYS = {
  KeyW: [0, 1], KeyS: [0, -1], KeyA: [1, 1], KeyD: [1, -1], KeyR: [2, 1], KeyF: [2, -1],
  KeyC: [3, 1], KeyZ: [3, -1], KeyB: [4, 1], KeyV: [4, -1], KeyQ: [5, 1], KeyE: [5, -1],
  KeyO: [6, 1], KeyP: [6, -1],
};
const OUTCOMES = { Enter: "success", KeyN: "failure", Backspace: "discarded" };

/** Buttons of the standard gamepad, and what they do when pressed. */
const BUTTONS = { 0: "success", 3: "failure", 1: "discarded" };
const [LT, RT, LB, UP, DOWN, LEFT, RIGHT] = [6, 7, 4, 12, 13, 14, 15];

const MAPPING = [
  ["W S · A D · R F", "left stick · right stick up, down", "along x · y · z"],
  ["C Z · B V · Q E", "D-pad right, left · up, down · right stick", "about x · y · z"],
  ["O P", "triggers LT RT", "gripper towards its largest, smallest set-point"],
  ["shift", "shoulder LB", "slower"],
  ["enter", "A", "success, and reset"],
  ["N", "Y", "failure, and reset"],
  ["backspace", "B", "discard, and reset"],
];

const ui = {};
const held = new Set();
let shift = false;
let pressed = new Set();
let active = false;
let moving = false;
let sent = 0;

/** The velocities that the held keys command: along and about x, y and z, and of the gripper. */
function fromKeys() {
  const found = new Array(7).fill(0);
  for (const code of held) {
    const [index, sign] = KEYS[code];
    found[index] += shift ? sign * SLOW : sign;
  }
  return found;
}

const beyond = (value) => (Math.abs(value ?? 0) < DEAD ? 0 : (value - Math.sign(value) * DEAD) / (1 - DEAD));

/** The velocities that a gamepad commands. */
function fromGamepad(pad) {
  const [x, y, turn, lift] = [0, 1, 2, 3].map((axis) => beyond(pad.axes[axis]));
  const by = (index) => pad.buttons[index]?.value ?? 0;
  const scale = by(LB) > 0.5 ? SLOW : 1;
  return [-y, -x, -lift, by(RIGHT) - by(LEFT), by(UP) - by(DOWN), -turn, by(LT) - by(RT)].map((value) => value * scale);
}

const gamepad = () => [...(navigator.getGamepads?.() ?? [])].find((pad) => pad?.connected && pad.mapping === "standard");

async function judge(outcome) {
  if ((await ask("POST", "api/recording/outcome", { outcome })) !== null) reset($("keyframe").value);
}

/** Return the outcomes of the buttons pressed since the last call. */
function newly(pad) {
  const down = new Set(Object.keys(BUTTONS).filter((index) => pad?.buttons[index]?.pressed));
  const fresh = [...down].filter((index) => !pressed.has(index));
  pressed = down;
  return fresh.map((index) => BUTTONS[index]);
}

function look() {
  if (!active) return;
  requestAnimationFrame(look);
  const pad = gamepad();
  const still = now.status?.running ? "" : " Physics is stopped: press Play.";
  const other = pad ? `Gamepad: ${pad.id}.` : "No gamepad: to use one, connect it and press a button on it.";
  text(ui.pad, `Keys W S A D R F move it, and those under “Keys and buttons”. ${other}${still}`);
  newly(pad).forEach(judge);
  const sticks = pad ? fromGamepad(pad) : new Array(7).fill(0);
  const asked = fromKeys().map((value, i) => Math.max(-1, Math.min(1, value + sticks[i])));
  const moves = asked.some((value) => value !== 0);
  const time = performance.now();
  if (!(moves || moving) || (moves && time - sent < PERIOD_MS)) return;
  moving = moves; // a message with zero velocities ends the motion
  sent = time;
  send({ type: "hand", articulation: ui.robot.value, linear: asked.slice(0, 3), angular: asked.slice(3, 6), gripper: asked[6], site: ui.site.value.trim() });
}

function toggle(wanted) {
  active = wanted && ui.robot.value !== "";
  held.clear();
  pressed = new Set(Object.keys(BUTTONS).filter((index) => gamepad()?.buttons[index]?.pressed));
  ui.drive.setAttribute("aria-pressed", active);
  ui.drive.classList.toggle("primary", active);
  text(ui.drive, active ? "Stop driving the hand" : "Drive the hand");
  if (active) look();
  else {
    if (moving) send({ type: "hand", articulation: ui.robot.value, site: ui.site.value.trim() });
    moving = false;
    text(ui.pad, "");
  }
}

/** While the hand is driven, its keys take precedence, except in text fields; escape still stops. */
function key(event) {
  shift = event.shiftKey;
  if (!active || event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
  if (event.target.closest?.("input:not([type=range], [type=checkbox]), select, textarea")) return;
  const outcome = OUTCOMES[event.code];
  if (!(event.code in KEYS) && !outcome) return;
  event.preventDefault();
  event.stopPropagation();
  if (event.type === "keyup") held.delete(event.code);
  else if (!outcome) held.add(event.code);
  else if (!event.repeat) judge(outcome);
}

export function makeTeleop() {
  ui.drive = h("button", { id: "drive-hand", "aria-pressed": "false", onclick: () => { toggle(!active); ui.drive.blur(); } }, "Drive the hand");
  ui.robot = h("select", { id: "hand-robot", "aria-label": "Robot whose hand to drive" });
  ui.site = h("input", { id: "hand-site", placeholder: "its only site", "aria-label": "Site of the hand", size: 12 });
  ui.pad = h("p", { class: "hint", id: "gamepad" });
  const outcomes = [["success", "Success"], ["failure", "Failure"], ["discarded", "Discard"]].map(([outcome, label]) =>
    h("button", { class: "quiet", "data-outcome": outcome, title: `${label}, and reset`, disabled: true, onclick: () => judge(outcome) }, label));
  $("teleop").append(heading("Hand"),
    h("div", { class: "line" }, ui.drive, ui.robot, h("label", {}, "site ", ui.site)),
    ui.pad,
    h("div", { class: "line" }, h("span", { class: "hint" }, "Mark the recorded episode, and reset:"), ...outcomes),
    h("details", {}, h("summary", {}, "Keys and buttons"),
      h("table", { class: "mapping" }, h("tr", {}, ...["keys", "gamepad", "world frame: x forward, y left, z up"].map((head) => h("th", {}, head))),
        ...MAPPING.map((row) => h("tr", {}, ...row.map((cell) => h("td", {}, cell)))))));
  on("world", ({ world }) => {
    const robots = world.articulations.filter((art) => art.actuators.some((actuator) => actuator.takes === "position"));
    choices(ui.robot, robots.map((art) => [art.key, art.key]));
    $("teleop").hidden = robots.length === 0;
    if (active && !robots.length) toggle(false);
  });
  on("status", () => outcomes.forEach((button) => { button.disabled = now.status.recording === null; }));
  on("refused", () => active && moving && toggle(false));
  on("closed", () => active && toggle(false));
  for (const type of ["keydown", "keyup"]) window.addEventListener(type, key, { capture: true });
  window.addEventListener("blur", () => held.clear());
}
