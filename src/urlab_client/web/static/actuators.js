// A value with its limits as slider and number, and rows of the joint panel: an actuator's set-point beside the measured joint position.

import { h, number, text, toast } from "./dom.js";
import { setPoint } from "./link.js";

export const HELD_MS = 700;
export const UNKNOWN = { position: [-Math.PI, Math.PI], velocity: [-5, 5], force: [-10, 10], "": [-1, 1] };
const MEANINGS = { position: "Position", velocity: "Velocity", force: "Force or torque", "": "Control" };
const FORCES = { "N m": "Torque", N: "Force" };

export function share(value, [low, high]) {
  return Math.min(1, Math.max(0, (value - low) / (high - low || 1)));
}

/** The number of digits needed to tell values of this range apart. */
export const digits = ([low, high]) => Math.min(4, Math.max(1, 3 - Math.floor(Math.log10(Math.max(1e-3, high - low)))));

const shortly = (value) => `${+value.toPrecision(3)}`.replace("-", "−");

/** Actuators grouped by scale: the meaning and unit of their set-points. */
export function groups(art) {
  const found = new Map();
  for (const actuator of art.actuators) {
    const key = `${actuator.takes}|${actuator.unit}`;
    if (!found.has(key)) found.set(key, { takes: actuator.takes, unit: actuator.unit, actuators: [] });
    found.get(key).actuators.push(actuator);
  }
  return [...found.values()];
}

/** A slider and a number field for one value with the limits `range`, or none; `send` is called with what a user sets. */
export class Setting {
  constructor(name, { unit, range, scale, label, send, slider = {}, box = {} }) {
    Object.assign(this, { name, unit, range, scale: range ?? scale, send, held: -Infinity });
    const [low, high] = this.scale;
    const { limits } = this;
    this.slider = h("input", { type: "range", min: low, max: high, step: (high - low) / 1000, value: 0,
      "aria-label": `${label}${unit ? `, ${unit}` : ""}`, oninput: () => this.set(+this.slider.value), ...slider });
    this.box = h("input", { type: "number", step: "any", title: limits, "aria-label": `${label} as a number`,
      onchange: () => this.box.value !== "" && this.type(+this.box.value), ...box });
    this.ends = [["low", low], ["high", high]].map(([end, value]) => h("small", { class: end }, range ? shortly(value) : "no limit"));
  }

  get limits() {
    return this.range ? `${this.range.map(shortly).join(" … ")} ${this.unit}` : "no limits";
  }

  set(value) {
    const [low, high] = this.range ?? [-Infinity, Infinity];
    const within = Math.min(Math.max(value, low), high);
    this.held = performance.now();
    this.slider.value = within;
    this.write(within);
    this.send(within);
  }

  /** Set what was typed, and say where it ends. */
  type(value) {
    const [low, high] = this.range ?? [-Infinity, Infinity];
    if (value < low || value > high) toast(`${this.name} goes from ${shortly(low)} to ${shortly(high)} ${this.unit}: ${shortly(value)} is out of reach, so it is set to ${shortly(value < low ? low : high)}.`);
    this.set(value);
  }

  write(value) {
    if (document.activeElement !== this.box || performance.now() - this.held < HELD_MS) this.box.value = value.toFixed(digits(this.scale)).replace(/^-(?=0\.?0*$)/, "");
  }

  /** Show a value that came, but not while the user moves it: the state is older than the input. */
  show(value) {
    if (value == null || performance.now() - this.held <= HELD_MS || this.slider.matches(":active")) return;
    this.slider.value = value;
    this.write(value);
  }
}

export class ActuatorRow extends Setting {
  constructor(robot, actuator, art) {
    const { name } = actuator;
    super(name, { unit: actuator.unit, range: actuator.range, scale: UNKNOWN[actuator.takes], label: `${name} set-point`,
      send: (value) => setPoint(robot, name, value), slider: { "data-actuator": name }, box: { "data-set-point": name } });
    this.actuator = actuator;
    this.joint = art.joints.find((one) => one.name === actuator.joint);
    this.follows = actuator.takes === "position" && this.joint !== undefined; // the joint is on the slider's scale
    this.mark = h("i", { class: "mark", title: this.follows ? "Joint position" : "Applied control" });
    this.measured = h("span", { class: "num", "data-value": name });
    this.element = h("div", { class: "line", role: "group", "aria-label": name },
      h("span", { class: "name", title: [actuator.kind, actuator.joint && `drives ${actuator.joint}`, this.limits].filter(Boolean).join(", ") }, name),
      h("span", { class: "track" }, this.slider, this.mark, this.ends),
      this.box, this.measured,
      h("span", { class: "few" },
        h("button", { class: "tiny", title: `${name} to 0`, "aria-label": `${name} to 0`, onclick: () => this.zero() }, "0"),
        h("button", { class: "tiny", title: `${name} home`, "aria-label": `${name} home`, onclick: () => this.home() }, "⌂")));
  }

  zero() {
    this.set(0);
  }

  home() {
    this.set(this.actuator.home);
  }

  draw(state) {
    const { index } = this.actuator;
    const applied = state.ctrl?.[index];
    const position = this.joint && state.qpos?.[this.joint.index];
    const target = state.targets?.[index] ?? (this.follows ? position : applied);
    this.show(target);
    const where = this.follows ? position : applied;
    this.mark.style.left = `calc(8px + ${share(where ?? 0, this.scale)} * (100% - 16px))`; // the range of the thumb's centre
    const shown = this.joint ? [position, this.joint.unit] : [applied, this.actuator.unit];
    text(this.measured, `${number(shown[0])} ${shown[1]}`);
  }
}

/** A table of actuators of one scale, with buttons that act on all of them. */
export function actuatorTable(group, rows) {
  const act = (what) => rows.forEach((row) => row[what]());
  return h("div", { class: "table actuators" },
    h("div", { class: "line head" },
      h("span", { class: "name" }, `${FORCES[group.unit] ?? MEANINGS[group.takes]}${group.unit ? ` · ${group.unit}` : ""}`),
      h("span", {}, "set-point"), h("span", {}, "command"), h("span", { class: "right" }, !rows.some((row) => row.joint) ? "applied" : group.takes === "position" ? "measured" : "joint"),
      h("span", { class: "few" },
        h("button", { class: "tiny", title: "All to 0", "aria-label": "All to 0", onclick: () => act("zero") }, "0"),
        h("button", { class: "tiny", title: "All home", "aria-label": "All home", onclick: () => act("home") }, "⌂"))),
    rows.map((row) => row.element));
}

const TURNS = ["hinge", "slide"];

/** Whether torque motors of a robot can hold its joints in a pose. */
export const canHold = (art) => art.actuators.some((actuator) => actuator.takes === "force"
  && art.joints.some((joint) => joint.name === actuator.joint && TURNS.includes(joint.kind)));

/** What an actuator is given: what the console has commanded, or what was applied at the last step. */
const given = (actuator, state) => (state?.targets ?? state?.ctrl)?.[actuator.index] ?? 0;

const free = (art) => art.joints.find((joint) => joint.kind === "free");

/** Whether a robot that stands on its own would collapse when physics runs, because nobody commands it. */
export const limp = (art, state) => canHold(art) && free(art) !== undefined && art.actuators.every((actuator) => !given(actuator, state));

/** Whether a robot lies on the ground: its base hangs low, or leans by more than 60°. */
export function fallen(art, state) {
  const base = free(art);
  if (!base || !(art.height > 0) || !state?.qpos) return false;
  const [z, , x, y] = state.qpos.slice(base.index + 2, base.index + 6);
  return z < 0.6 * art.height || 1 - 2 * (x * x + y * y) < 0.5;
}

/** Whether Play keeps a mode in which the console cannot hold a pose, because somebody has chosen it. */
export const staysInMode = (status) => status?.mode_chosen && status.mode !== "direct";

/** What holds a robot, or the reason why it does not move, as far as its state shows it; or an empty string. */
export function stillness(art, state, status) {
  if (status?.replay || status?.link.state === "taken_over") return "";
  if (status?.mode === "puppet") return "In mode puppet no physics runs. Place its joints below" + (free(art) ? ", or push it in the view." : ".");
  if (!art.actuators.length) return "It has no actuators: only gravity and contacts move it.";
  if (status?.source === "ui") return "The editor's panel drives it. To use the set-points from here, choose those of “programs” in the bar.";
  if (status?.holding.includes(art.key) && fallen(art, state)) return "It holds its home pose, but has fallen. Press Reset to.";
  if (status?.holding.includes(art.key)) return `It holds its home pose ${status.moving ? "until you move a slider" : "as soon as physics runs"}.`;
  const limits = Object.values(art.controller?.params.torque_limit ?? {});
  if (limits.length && limits.every((limit) => limit === 0)) return "Its torque limits are 0, so nothing drives it. Raise them under “Gains”.";
  const forces = art.actuators.filter((actuator) => actuator.takes === "force");
  if (canHold(art) && fallen(art, state)) return "It has fallen. “Reset and hold” stands it up.";
  if (forces.length === art.actuators.length && forces.every((actuator) => !given(actuator, state))) {
    if (limp(art, state) && status?.moving) return "Nothing drives it, so it falls. “Hold pose” makes it stand.";
    if (limp(art, state) && staysInMode(status)) return `Nothing drives it, so it falls in mode ${status.mode}. “Hold pose” chooses direct, and makes it stand.`;
    return limp(art, state) ? `Nothing drives it yet. Play makes it hold its pose${status?.mode === "direct" ? "" : ", and chooses mode direct for that"}.`
      : "Nothing drives it: all its forces are 0. Move a slider, or run a policy.";
  }
  return canHold(art) && free(art) ? "Set-points drive it. “Hold pose” takes over." : "";
}
