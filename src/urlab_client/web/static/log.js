// The log of calls, errors and events, in sentences; immediate repetitions are counted.

import { $, h, heading, plain, text } from "./dom.js";
import { on } from "./link.js";

const KEPT = 300;

/** The text of each connection event. */
const EVENTS = {
  connected: () => "The console is connected to the server.",
  session_opened: (text, away) => `${away ? "The server was restarted, or another program had it in the meantime: this is a new session" : "A session was opened"}${/mujoco_version ([^,]+)/.test(text) ? `; MuJoCo ${/mujoco_version ([^,]+)/.exec(text)[1]}` : ""}.`,
  play_started: (text) => `The play session began${/\[(.*)\]/.test(text) ? ` with ${/\[(.*)\]/.exec(text)[1].replaceAll("'", "")}` : ""}.`,
  play_ended: () => "The play session ended.",
  lost: () => "The server is unreachable. Retrying.",
  reconnected: () => "The server is reachable again.",
  silent: () => "The server is not answering.",
  answers: () => "The server is answering again.",
  session_lost: (_, away) => (away ? "The session is gone: the server was restarted, or another program took it over."
    : "Another program took the session over."),
};

/** What the console's own troubles mean for who watches; their details are in the line's title. */
const TROUBLES = {
  connect: "The server is unreachable. Retrying.",
  state: "States stopped arriving. Trying again.",
  step: "A step failed, so physics was paused.",
  "set-points": "Set-points did not reach the server.",
};

/** Values by name; of many that are the same, the value. */
function alike(values) {
  const [first, ...rest] = Object.values(values);
  return rest.length > 2 && rest.every((value) => value === first) ? `${shortly(first)} for ${rest.length + 1} actuators` : shortly(values);
}

const each = (given, did, what) => Object.entries(given).map(([robot, names]) => `${did} ${names.length > 3 ? `${names.length} ${what}` : names.join(", ")} of ${robot}`).join("; ");

/** What viewers do most, in words; `given` are the arguments. */
const CALLS = {
  set_paused: (given) => (given.paused ? "paused physics" : "let physics run"),
  run: () => "let physics run",
  step: (given) => `took ${given.n_steps} step${given.n_steps === 1 ? "" : "s"}`,
  configure_controller: (given) => Object.entries(given.params).map(([gain, values]) => `set ${gain.replaceAll("_", " ")} of ${given.articulation}: ${alike(values)}`).join("; "),
  stop: () => "paused physics",
  reset: (given) => `reset the simulation${given.keyframe_name ? ` to ${given.keyframe_name}` : ""}`,
  restore_mode: (given) => `chose step mode ${given.mode}, as before the other program`,
  set_mode: (given) => `chose step mode ${given.mode}`,
  set_sim_speed: (given) => `set the speed to ${shortly(given.percent)} %`,
  set_control_source: (given) => `made set-points of ${given.source === "ui" ? "the editor panel" : "programs"} drive`,
  begin_pie: () => "began play",
  stop_pie: () => "ended play",
  set_twist: (given) => `commanded ${given.articulation} to move`,
  spawn_actor: (given) => `added ${given.actor_id || "an actor"}`,
  duplicate_actor: (given) => `added ${given.new_actor_id}, a copy of ${given.target}`,
  destroy_actor: (given) => `removed ${given.target}`,
  set_actor_transform: (given) => `moved ${given.target}`,
  ensure_manager: () => "added a manager to the level",
  "take the controls": () => "took the controls",
  "release the controls": () => "released the controls",
  "hold pose": (given) => `made ${given} hold its home pose`,
  "let go": (given) => `let ${given} go`,
  "set-points": (given) => each(given, "set", "set-points"),
  pose: (given) => each(given, "placed", "joints"),
  "drive hand": (given) => `moved the hand of ${given}`,
  record: (given) => `began recording ${given}`,
  "stop recording": (given) => `finished recording ${given}`,
  replay: (given) => `replayed ${given}`,
  "replay in the simulation": (given) => `replayed ${given}, which moves the simulation`,
  "end replay": () => "went back to live",
  "upload recording": (given) => `added the recording ${given}`,
  "delete recording": (given) => `deleted the recording ${given}`,
  episode: (given) => `marked the episode: ${given}`,
  "import model": (given) => `imported ${given}`,
};

/** What sliders and pads repeat while they move: of these the newest value counts. */
const MOVED = new Set(["set_sim_speed", "set_twist", "set_sim_options", "configure_controller"]);

const clockTime = (entry) => new Date(entry.at * 1000).toLocaleTimeString([], { hour12: false });
const inFull = (entry) => `${entry.what} ${entry.text}`;

function shortly(value) {
  if (typeof value === "number") return `${+value.toPrecision(4)}`;
  if (Array.isArray(value)) return value.map(shortly).join(" ");
  return value && typeof value === "object" ? Object.entries(value).map(([name, one]) => `${name} ${shortly(one)}`).join(", ") : `${value}`;
}

/** The arguments of an op, or a sentence as it is. */
function argumentsOf(entry) {
  try {
    return JSON.parse(entry.text);
  } catch {
    return entry.text;
  }
}

/** An entry as a sentence: `set_sim_speed {"percent":50}` is `set the speed to 50 %`. */
function words(entry, away) {
  if (entry.kind === "event") return EVENTS[entry.what]?.(entry.text, away) ?? `${entry.what.replaceAll("_", " ")}: ${entry.text}`;
  if (entry.kind === "error") return (entry.who === "console" && TROUBLES[entry.what]) || `${entry.what.replaceAll("_", " ")}: ${plain(entry.text)}`;
  const given = argumentsOf(entry);
  if (CALLS[entry.what]) return CALLS[entry.what](given);
  const shown = typeof given === "string" ? given : Object.entries(given).filter(([, value]) => value !== null)
    .map(([name, value]) => `${name.replaceAll("_", " ")} ${shortly(value)}`).join(", ");
  return [entry.what.replaceAll("_", " "), shown].filter(Boolean).join(": ");
}

export function makeLog() {
  const list = h("ol", { class: "entries", tabindex: 0, "aria-label": "Log" });
  const only = h("input", { type: "checkbox", onchange: () => list.classList.toggle("errors", only.checked) });
  $("log").append(heading("Log", h("span", { class: "space" }), h("label", { class: "check hint" }, only, " errors only")), list);
  let newest = -1;
  let last = null; // the latest line: its text and count
  let lost = false; // what follows from a loss needs no lines of its own
  let away = false; // from a loss until the next session
  let over = false; // the console has gone, and the next one tells its own log from the start
  on("closed", () => { over = true; });

  function begin() {
    newest = -1;
    last = null;
    lost = away = over = false;
    list.replaceChildren();
  }

  function add(entry) {
    if (entry.kind === "event") lost = entry.what === "lost" || (lost && !["connected", "reconnected"].includes(entry.what));
    if (lost && ((entry.kind === "error" && entry.who === "console") || entry.what === "silent")) return;
    if (entry.what === "lost") away = true;
    const said = words(entry, away);
    if (entry.what === "session_opened") away = false;
    const same = JSON.stringify([entry.kind, entry.who, entry.what, MOVED.has(entry.what) || said]);
    if (last?.same === same) {
      last.times += 1;
      text(last.count, `×${last.times}`);
      text(last.said, said);
      text(last.time, clockTime(entry));
      last.said.title = inFull(entry);
      return;
    }
    last = { same, times: 1, time: h("time", {}, clockTime(entry)), count: h("span", { class: "tag" }), said: h("span", { class: "said", title: inFull(entry) }, said) };
    list.append(h("li", { class: entry.kind }, last.time, h("span", { class: "who" }, entry.who), last.said, last.count));
  }

  on("log", ({ entries }) => {
    if (over) begin();
    const bottom = list.scrollTop + list.clientHeight > list.scrollHeight - 20;
    for (const entry of entries) {
      if (entry.n <= newest) continue;
      newest = entry.n;
      add(entry);
    }
    while (list.children.length > KEPT) list.firstChild.remove();
    if (bottom) list.scrollTop = list.scrollHeight;
  });
}
