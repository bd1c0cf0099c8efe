// Articulations: joint positions against their ranges, actuator sliders, gains, commanded twist.

import { ActuatorRow, Setting, UNKNOWN, actuatorTable, canHold, fallen, groups, limp, share, staysInMode, stillness } from "./actuators.js";
import { now, reset } from "./bar.js";
import { $, h, heading, number, text, toast } from "./dom.js";
import { ask, newest, on, op } from "./link.js";

let robots = [];
const PRESSING_N = 5;
const GAINS = ["kp", "kv", "torque_limit"];

class Robot {
  constructor(art) {
    this.key = art.key;
    this.art = art;
    this.shape = shape(art);
    this.rows = [];
    this.boxes = [];
    const joints = art.joints.filter((joint) => joint.kind === "hinge" || joint.kind === "slide");
    const driven = new Set(art.actuators.map((actuator) => actuator.joint));
    this.said = h("span", {});
    this.hold = h("button", { "aria-pressed": "false", title: "Keep the joints at the home pose; this needs mode direct, and chooses it",
      onclick: () => this.toggle() }, "Hold pose");
    // Once shown, it keeps its place: what is below must not move from under a finger.
    this.still = h("div", { class: "line still over", hidden: !canHold(art) }, this.said, h("span", { class: "space" }), canHold(art) ? this.hold : null);
    const why = h("button", { class: "quiet why", title: "Check everything from the sockets to the set-points", onclick: () => explain(art.key) }, "Why does it not move?");
    this.tables = groups(art).map((group) => actuatorTable(group, group.actuators.map((actuator) => this.actuator(actuator, art))));
    this.joints = fold("Joints", joints.some((joint) => !driven.has(joint.name)) && !art.actuators.length,
      h("div", { class: "table joints" }, joints.map((joint) => this.joint(joint))));
    this.posing = false;
    this.element = h("section", { class: "card robot", "data-robot": art.key, "aria-label": art.key },
      heading(art.key, h("span", { class: "tag", title: "Its name in the level" }, art.actor_id === art.key ? "" : art.actor_id), h("span", { class: "tag" }, `${count(art.joints.length, "joint")} · ${count(art.actuators.length, "actuator")}`),
        h("span", { class: "space" }), why),
      this.still, ...this.tables,
      this.joints,
      art.controller && GAINS.some((gain) => gain in art.controller.params) ? fold("Gains", false, this.gains(art)) : null,
      art.joints.some((joint) => joint.kind === "free") ? fold("Commanded twist", false, this.twist()) : null);
  }

  /** Hold the home pose, or let go. A robot that has fallen is held before it is put back, or it would fall again. */
  async toggle() {
    const holding = this.hold.getAttribute("aria-pressed") === "true";
    const lies = !holding && fallen(this.art, now.state?.articulations[this.key]);
    if ((await hold([this.key], !holding)) !== null && lies) await reset();
  }

  actuator(actuator, art) {
    const row = new ActuatorRow(this.key, actuator, art);
    this.rows.push((state) => row.draw(state));
    return row;
  }

  /** A joint on its range; in mode puppet, a slider and a number place it. */
  joint(joint) {
    const { name, unit, range } = joint;
    const setting = new Setting(name, { unit, range, scale: unit === "m" ? UNKNOWN[""] : UNKNOWN.position, label: `Place ${name}`,
      send: newest((value) => ask("POST", "api/pose", { [this.key]: { [name]: value } })), slider: { "data-place": name }, box: { "data-placed": name } });
    const placing = [setting.slider, setting.box, ...setting.ends];
    const bar = range ? h("i", { class: "mark" }) : h("small", {}, "no limits");
    const shown = h("span", { class: "num", "data-joint": name });
    this.rows.push((state) => {
      const value = state.qpos?.[joint.index];
      text(shown, `${number(value)} ${unit}`);
      placing.forEach((one) => { one.hidden = !this.posing; });
      bar.hidden = this.posing;
      setting.show(value);
      if (!range || value == null) return;
      const at = share(value, range);
      bar.style.left = `${100 * at}%`;
      bar.classList.toggle("limit", at < 0.02 || at > 0.98);
    });
    return h("div", { class: "line", title: setting.limits }, h("span", { class: "name" }, name),
      h("span", { class: range ? "track bar" : "track" }, setting.slider, bar, setting.ends), setting.box, shown);
  }

  /** A table of gains by actuator; its first row sets those of all. */
  gains(art) {
    const head = h("tr", {}, h("th", {}), ...GAINS.map((gain) => h("th", {}, gain.replace("_", " "))));
    const names = art.actuators.map((actuator) => actuator.name);
    const row = (label, those) => h("tr", {}, h("th", {}, label), ...GAINS.map((gain) => h("td", {}, this.gain(gain, label, those.filter((name) => art.controller.params[gain]?.[name] !== undefined)))));
    return h("table", { class: "gains" }, head, ...(names.length > 1 ? [row("all", names)] : []), ...names.map((name) => row(name, [name])));
  }

  /** A box with a gain of some actuators; empty while they differ. */
  gain(gain, label, names) {
    const common = (params) => {
      const found = new Set(names.map((name) => params[gain]?.[name]));
      return found.size === 1 ? String([...found][0] ?? "") : "";
    };
    const box = h("input", { type: "number", min: 0, step: "any", value: common(this.art.controller.params), "aria-label": `${gain} of ${label}`,
      disabled: !names.length, "data-gain": `${gain}/${label}` });
    let known = box.value;
    this.boxes.push((params) => {
      known = common(params);
      if (document.activeElement !== box) box.value = known;
    });
    box.addEventListener("change", async () => {
      const body = { articulation: this.key, params: { [gain]: Object.fromEntries(names.map((name) => [name, +box.value])) } };
      if (box.value === "" || (await op("configure_controller", body)) === null) box.value = known;
    });
    return box;
  }

  twist() {
    const knob = h("i", {});
    const pad = h("div", { class: "pad", tabindex: 0, role: "application", "aria-label": "Twist: W A S D", title: "Drag to command forward speed and turn rate, or use W A S D while focused" }, knob);
    const shown = h("span", { class: "num" }, "0 m/s · 0 rad/s");
    const command = newest((body) => op("set_twist", body));
    const push = (vx, yaw) => {
      knob.style.left = `${50 - 45 * yaw}%`;
      knob.style.top = `${50 - 45 * vx}%`;
      text(shown, `${vx.toFixed(2)} m/s · ${yaw.toFixed(2)} rad/s`);
      command({ articulation: this.key, linear: [vx, 0, 0], angular: [0, 0, yaw] });
    };
    const drag = (event) => {
      const box = pad.getBoundingClientRect();
      const clamp = (value) => Math.max(-1, Math.min(1, value));
      push(clamp(1 - (2 * (event.clientY - box.top)) / box.height), clamp(1 - (2 * (event.clientX - box.left)) / box.width));
    };
    pad.addEventListener("pointerdown", (event) => { pad.setPointerCapture(event.pointerId); drag(event); });
    pad.addEventListener("pointermove", (event) => pad.hasPointerCapture(event.pointerId) && drag(event));
    pad.addEventListener("lostpointercapture", () => push(0, 0));
    const keys = { w: [0.5, 0], s: [-0.5, 0], a: [0, 0.5], d: [0, -0.5] };
    pad.addEventListener("keydown", (event) => { if (keys[event.key] && !event.repeat) { event.stopPropagation(); push(...keys[event.key]); } });
    pad.addEventListener("keyup", (event) => keys[event.key] && push(0, 0));
    return h("div", { class: "twist" }, pad, h("div", {}, shown, h("p", { class: "hint" },
      "The command that a policy on the server reads. It moves nothing by itself.")));
  }

  /** Update values that may change while the robot stays the same, except a field that the user edits. */
  update(art) {
    this.art = art;
    for (const take of this.boxes) take(art.controller?.params ?? {});
  }

  draw(state) {
    const puppet = now.status?.mode === "puppet";
    const posing = puppet && !now.status.replay;
    if (posing && !this.posing) this.joints.open = true;
    this.posing = posing;
    for (const row of this.rows) row(state);
    for (const table of this.tables) table.inert = puppet; // where set-points do nothing
    const said = stillness(this.art, state, now.status);
    if (said) this.still.hidden = false;
    this.still.classList.toggle("over", !said);
    text(this.said, said);
    const holding = now.status?.holding.includes(this.key) ?? false;
    this.hold.setAttribute("aria-pressed", holding);
    text(this.hold, !holding && fallen(this.art, state) ? "Reset and hold" : "Hold pose");
  }
}

/** Let robots hold their home pose, or let go; say so if that changes the mode. */
async function hold(keys, holding) {
  const { mode } = now.status;
  const answer = await ask("POST", "api/hold", Object.fromEntries(keys.map((key) => [key, holding])));
  if (answer !== null && holding && mode !== "direct") toast(`The mode is now direct, not ${mode}, because ${keys.join(", ")} can hold a pose only in direct.`, "good");
  return answer;
}

/** Before physics runs: make those robots hold their pose that would collapse, unless the editor's panel drives them. */
export async function steady() {
  if (now.status.source === "ui" || staysInMode(now.status)) return;
  const held = robots.filter(({ art, key }) => limp(art, now.state?.articulations[key]) && !now.status.holding.includes(key)).map(({ key }) => key);
  if (held.length) await hold(held, true);
}

const count = (n, what) => `${n} ${what}${n === 1 ? "" : "s"}`;

/** What a program calls, as what a viewer presses. */
const PRESS = [
  [/Call runtime\.set_paused\(False\).*?--unpaused\./, "Press Play."],
  [/Call runtime\.set_control_source\('zmq'\)\./, "Choose set-points of “programs” in the bar."],
  [/Set them with set_ctrl\(\) or ctrl_array before step\(\)\./, "Move a slider."],
  [/step\(\) has not been called since discover\(\)\. Nothing moves without it\./, "No step has been taken. Press Play."],
  [/Call sim\.start\(\)\./, "Press Begin play."],
  [/Raise it with set_gains\(\)\./, "Raise it under “Gains”."],
];

/** What the client examines, in words of this page. */
const ABOUT = { RPC: "Connection", play: "Physics", steps: "Step mode", articulations: "Robots" };
const wordFor = (subject) => ABOUT[subject] ?? (robots.find(({ key }) => key === subject)?.art.actor_id || subject[0].toUpperCase() + subject.slice(1));

/** Whether a finding keeps all of physics from running. */
const isPlay = ({ subject }) => subject === "play";

/** Where parts of a robot press against each other, the strongest first. */
async function pressing(key) {
  if (!now.status?.playing || now.status.link.state !== "connected") return [];
  const answer = await op("get_contacts", { max_contacts: 64 }, { quiet: true });
  const own = (answer?.contacts ?? []).filter(({ body1, body2 }) => [body1, body2].every((body) => body?.startsWith(`${key}_`)));
  own.sort((one, other) => other.force[0] - one.force[0]);
  return own.filter(({ force }) => force[0] > PRESSING_N).slice(0, 3)
    .map(({ body1, body2, force }) => `Its parts ${body1} and ${body2} press against each other with ${force[0].toFixed(0)} N.`);
}

/** Show the client's diagnosis of a robot that does not move. */
async function explain(key) {
  const [answer, pressed] = await Promise.all([ask("GET", "api/explain"), pressing(key)]);
  if (!answer) return;
  const robot = robots.find((one) => one.key === key);
  const said = robot && now.state ? stillness(robot.art, now.state.articulations[key], now.status) : "";
  const beside = now.status?.mode === "puppet" ? ["steps", key] : []; // where no step and no set-point is wanted
  const paused = now.status?.mode === "direct" && !now.status.running ? [{ subject: "play", verdict: "problem", text: "Nothing steps it now. Press Play." }] : [];
  if (paused.length) beside.push("steps"); // the same, in words for programs
  const about = [said, ...pressed].filter(Boolean).map((text) => ({ subject: key, verdict: "note", text }));
  const found = answer.findings.filter((one) => !beside.includes(one.subject) && one.verdict !== "ok" && !(said && one.text.startsWith("All set-points are 0"))
    && (one.subject === key || !document.querySelector(`[data-robot="${one.subject}"]`)));
  const findings = [...paused, ...found.filter(isPlay), ...about, ...found.filter((one) => !isPlay(one))];
  $("findings").replaceChildren(h("h2", {}, `Why does ${key} not move?`),
    h("ul", {}, findings.map((one) => h("li", { class: one.verdict }, h("b", {}, wordFor(one.subject)),
      ` ${PRESS.reduce((said, [call, press]) => said.replace(call, press), one.text)}`)),
      findings.length ? null : h("li", {}, "Nothing was found that keeps it from moving.")),
    h("form", { method: "dialog" }, h("button", {}, "Close")));
  $("findings").showModal();
}

export function fold(title, open, ...content) {
  return h("details", { open }, h("summary", {}, title), ...content);
}

export function makeRobots() {
  const list = h("div", { class: "list" });
  $("robots").append(list);
  on("world", ({ world }) => {
    const open = new Set([...document.querySelectorAll(".robot details[open]")].map(place));
    const before = document.querySelector(".robot") !== null;
    const old = robots;
    robots = world.articulations.map((art) => old.find((robot) => robot.shape === shape(art)) ?? new Robot(art));
    robots.forEach((robot, i) => robot.update(world.articulations[i]));
    if (old.length === robots.length && old.every((robot, i) => robot === robots[i])) return;
    list.replaceChildren(...robots.map((robot) => robot.element));
    if (before) for (const details of document.querySelectorAll(".robot details")) details.open = open.has(place(details));
  });
  on("state", (state) => {
    for (const robot of robots) if (state.articulations[robot.key]) robot.draw(state.articulations[robot.key]);
  });
}

/** The structure that a robot's panel depends on, as opposed to its values. */
function shape(art) {
  const { controller, ...rest } = art;
  return JSON.stringify([rest, controller && [controller.kind, GAINS.map((gain) => Object.keys(controller.params[gain] ?? {}))]]);
}

const place = (details) => `${details.closest(".robot").dataset.robot}/${details.firstChild.textContent}`;
