// The bar at the top: connection, age, time, play and stop, modes, driver.

import { $, announce, choices, confirmed, duration, h, text, toast } from "./dom.js";
import { ask, clock, on, op } from "./link.js";
import { pauseReplay, toggleReplay } from "./replay.js";
import { steady } from "./robots.js";

export const now = { status: null, state: null, socket: false, opened: 0 };
const ui = {};
let ran = false; // whether physics runs, or did before mode puppet

/** Whether simulation time stands still, and nothing is wrong with that. */
export const paused = () => now.socket && now.status?.link.state === "connected" && !now.status.moving && !now.status.running;

const STATE_DUE_MS = 5000;
const MODES = {
  live: "physics runs by itself, in real time",
  direct: "physics advances only by steps: of this console, while it plays, or of a program",
  puppet: "no physics; programs and people place the robots",
};
const RUN = "Run or pause physics (space)";
const LINKS = {
  connected: "Connected",
  connecting: "Connecting",
  lost: "Server lost",
  silent: "No reply",
  taken_over: "Taken over",
  gone: "No console",
};

/** On a phone, the picture comes first and a sheet below it holds the controls. */
const PHONE = matchMedia("(max-width: 700px)");

/** Open or close the sheet; the picture or curve that is looked at, the first whose middle is in sight, goes above it. */
function toggleSheet() {
  const picture = [...document.querySelectorAll(".stage:not(.unable), .camera, .curve")].find((one) => {
    const { top, bottom } = one.getBoundingClientRect();
    return top + bottom > 0 && top + bottom < 2 * innerHeight;
  });
  const open = document.body.classList.toggle("sheet");
  ui.sheet.setAttribute("aria-expanded", open);
  text(ui.sheet, open ? "Close" : "Controls");
  if (open) picture?.scrollIntoView();
}

export const run = (running) => ask("POST", "api/run", { running });
/** Take as many steps as the box says. */
export const step = () => ui.steps.reportValidity() && ask("POST", "api/step", { n_steps: +ui.steps.value });
export const reset = (keyframe) => op("reset", keyframe ? { keyframe_name: keyframe } : {});
export const drive = () =>
  now.status?.mine ? ask("DELETE", "api/lease") : ask("POST", "api/lease");

/** Choose a step mode; physics that stood still, before mode puppet as well, is paused at once in live mode. */
async function choose(mode) {
  const still = mode === "live" && !ran;
  if ((await op("set_mode", { mode })) && still) await op("set_paused", { paused: true });
}

export async function toggleRun() {
  if (now.status?.replay) toggleReplay();
  else if (now.status) {
    const { running } = now.status;
    if (!running) await steady();
    await run(!running);
  }
}

/** Stop whatever moves: physics, and a replay. */
export function stop() {
  if (!now.status?.replay?.alone) run(false);
  if (now.status?.replay) pauseReplay();
}

async function restartPlay() {
  await op("stop_pie");
  const answer = await op("begin_pie");
  if (answer?.compile_error) toast(answer.compile_error);
}

async function invite() {
  const answer = await ask("POST", "api/invitations", {});
  if (!answer) return;
  const link = h("input", { readonly: true, size: 48, "aria-label": "Link for one more browser", value: new URL(answer.path, location.href).href, onfocus: () => link.select() });
  const copy = h("button", { class: "primary", onclick: async () => {
    const copied = await navigator.clipboard?.writeText(link.value).then(() => true, () => false);
    text(copy, copied ? "Copied" : "Select the link, and copy it");
  } }, "Copy");
  $("invitation").replaceChildren(h("h2", {}, "Invite one more browser"),
    h("p", { class: "hint" }, "This link is good for one browser, once. Whoever opens it can watch, and take the controls while they are free."),
    h("div", { class: "row" }, link, copy, h("form", { method: "dialog" }, h("button", {}, "Close"))));
  $("invitation").showModal();
}

export function makeBar() {
  ui.link = h("span", { class: "pill link", id: "link" }, "Connecting");
  ui.address = h("span", { class: "address" });
  ui.age = h("b", { id: "age" }, "–");
  ui.time = h("b", { id: "time" }, "–");
  ui.rate = h("b", {}, "–");
  ui.play = h("button", { class: "primary", id: "play", title: RUN, onclick: toggleRun }, "▶ Play");
  ui.stop = h("button", { class: "danger", id: "stop", title: "Stop physics; anyone can (escape)", onclick: stop }, "■ Stop");
  ui.steps = h("input", { id: "steps", type: "number", min: 1, max: 10000, step: 1, required: true, value: 10, title: "Steps at a time", "aria-label": "Steps at a time" });
  ui.step = h("button", { id: "step", title: "Step, in direct mode (.)", onclick: step }, "Step");
  ui.keyframe = h("select", { id: "keyframe", "aria-label": "Keyframe", title: "A keyframe puts a free base where its model says, wherever the robot stands in the level" }, h("option", { value: "" }, "start"));
  ui.reset = h("button", { id: "reset", title: "Reset to the start or a keyframe (r)", onclick: () => reset(ui.keyframe.value) }, "Reset to");
  ui.mode = h("select", { id: "mode", "aria-label": "Step mode", onchange: () => choose(ui.mode.value) },
    ...Object.entries(MODES).map(([mode, what]) => h("option", { title: what }, mode)));
  ui.source = h("select", { id: "source", "aria-label": "Whose set-points drive", title: "Whose set-points drive the robots: those of programs and this console, or those of the editor's panel",
    onchange: () => ui.source.value && op("set_control_source", { source: ui.source.value }) },
    h("option", { value: "", hidden: true }, "not chosen"), h("option", { value: "zmq" }, "programs"), h("option", { value: "ui" }, "editor panel"));
  ui.speed = h("input", { id: "speed", type: "range", min: 5, max: 100, step: 5, value: 100, "aria-label": "Speed, percent of real time", title: "How fast physics runs in live mode, percent of real time",
    onchange: () => op("set_sim_speed", { percent: +ui.speed.value }), oninput: () => text(ui.speedText, `${ui.speed.value} %`) });
  ui.speedText = h("span", { class: "num" }, "100 %");
  ui.who = h("span", {});
  ui.others = h("span", { class: "others" });
  ui.driver = h("span", { id: "driver", class: "pill" }, ui.who, ui.others);
  ui.drive = h("button", { id: "drive", title: "Take or release the controls (d)", onclick: drive }, "Take the controls");
  ui.restart = confirmed({ id: "restart", title: "Begin a play session, or begin it anew" }, () => now.status?.playing ? "Restart play" : "Begin play",
    () => now.status?.playing && "Discard this simulation?", restartPlay);

  ui.sheet = h("button", { id: "sheet-toggle", "aria-expanded": "false", "aria-controls": "sheet", onclick: toggleSheet }, "Controls");
  ui.more = h("div", { class: "row more" },
    h("span", { class: "group" }, ui.step, ui.steps),
    h("span", { class: "group" }, ui.reset, ui.keyframe),
    h("label", {}, "mode ", ui.mode),
    h("label", {}, "set-points of ", ui.source),
    h("label", { class: "speed" }, "speed ", ui.speed, ui.speedText),
    ui.restart);

  $("bar").append(
    h("div", { class: "row" },
      h("h1", { class: "brand" }, h("img", { src: "static/icon.svg", alt: "", width: 24, height: 24 }), h("span", { class: "title" }, "URLab console")),
      ui.link, ui.address,
      h("span", { class: "facts" },
        h("span", { title: "Age of the state shown" }, "age ", ui.age),
        h("span", { title: "Simulation time" }, "time ", ui.time),
        h("span", { title: "Simulation time relative to real time" }, "pace ", ui.rate)),
      h("span", { class: "space" }),
      ui.driver,
      h("span", { class: "acts" }, ui.drive,
        h("button", { id: "invite", class: "quiet", title: "A link for one more browser", onclick: invite }, "Invite")),
      h("button", { id: "keys", class: "quiet", title: "Keys (?)", "aria-label": "Keys", onclick: () => $("help").showModal() }, "?")),
    h("div", { class: "row controls acts" }, ui.play, ui.stop, ui.sheet, ui.more));
  const root = document.documentElement.style;
  new ResizeObserver(([{ target }]) => root.setProperty("--bar", `${target.offsetHeight}px`)).observe($("bar"));
  const place = () => (PHONE.matches ? $("sheet").prepend(ui.more) : document.querySelector(".controls").append(ui.more));
  PHONE.addEventListener("change", place);
  place();

  on("open", () => { now.socket = true; now.since = null; now.opened = Date.now(); });
  on("closed", () => { now.socket = false; now.since = now.since ?? Date.now(); show(now.status); banner(); });
  on("status", (status) => {
    now.status = status;
    if (status.mode !== "puppet") ran = status.running;
    show(status);
    banner();
  });
  on("state", (state) => {
    const first = !now.state;
    now.state = state;
    if (first) banner();
  });
  on("world", async ({ world }) => {
    const answer = world.playing ? await op("list_keyframes", {}, { quiet: true }) : null;
    const names = (answer?.keyframes ?? []).map((key) => key.name).filter(Boolean);
    choices(ui.keyframe, [["", "start"], ...names.map((name) => [name, name])]);
  });
  setInterval(() => {
    if (now.state) {
      const age = Date.now() + clock.offset - now.state.made;
      const replayed = now.status?.replay != null;
      text(ui.age, replayed ? "replay" : paused() ? "paused" : duration(age));
      ui.age.classList.toggle("old", !replayed && now.status?.moving && age > 1000);
      text(ui.time, `${now.state.time.toFixed(2)} s`);
    }
    if (!now.socket || now.status?.link.state !== "connected" || !now.state) banner();
  }, 200);
}

/** Show the status; without a console nothing on the page is current, so all of it is inert. */
function show(status) {
  const link = now.socket ? status?.link.state : "gone";
  document.body.dataset.link = link ?? "connecting";
  text(ui.link, LINKS[link] ?? LINKS.connecting);
  for (const part of [document.querySelector("main"), ...document.querySelectorAll("#bar .acts")]) part.inert = !now.socket;
  if (!status || !now.socket) return;
  document.body.classList.toggle("watching", !status.mine && status.driver !== null);
  if (status.replay?.alone) text(ui.link, "Recorded file"); // there is no server to be connected with
  text(ui.address, status.replay?.alone ? "" : status.address);
  const unreachable = ["lost", "connecting"].includes(link) && !status.replay;
  text(ui.rate, unreachable || (!now.state && !status.replay) ? "–" : status.moving || status.running ? `${status.rate.toFixed(2)}×` : "paused");
  if (!unreachable) text(ui.play, (status.replay ? status.replay.playing : status.running) ? "❚❚ Pause" : "▶ Play");
  ui.play.disabled = unreachable || (!status.replay && (!status.playing || status.mode === "puppet"));
  ui.play.title = ui.play.disabled && status.mode === "puppet" ? "In mode puppet no physics runs: choose live or direct" : RUN;
  const away = link === "taken_over"; // another program steps, resets and commands
  ui.play.disabled ||= away;
  ui.stop.disabled = unreachable || away;
  ui.step.disabled = ui.steps.disabled = status.mode !== "direct";
  if (document.activeElement !== ui.mode) ui.mode.value = status.mode;
  ui.mode.title = `${status.mode}: ${MODES[status.mode] ?? ""}`;
  if (document.activeElement !== ui.source) ui.source.value = status.source ?? "";
  if (document.activeElement !== ui.speed && status.speed !== null) {
    ui.speed.value = status.speed;
    text(ui.speedText, `${Math.round(status.speed)} %`);
  }
  text(ui.others, status.viewers > 1 ? ` · ${status.viewers} viewers` : "");
  ui.driver.title = status.driver === null ? "Whoever acts first gets the controls"
    : `${status.mine ? "You lose" : `${status.driver} loses`} the controls at 0 s; each action begins anew at ${Math.round(status.lease)} s`;
  text(ui.who, status.driver === null ? "no driver"
    : `${status.mine ? "you drive" : `${status.driver} drives`} · ${Math.ceil(status.lease_left)} s`);
  ui.driver.dataset.who = status.mine ? "me" : status.driver === null ? "free" : "other";
  text(ui.drive, status.mine ? "Release" : "Take the controls");
  ui.drive.disabled = !status.mine && (unreachable || status.driver !== null);
  if (!ui.restart.classList.contains("danger")) text(ui.restart, status.playing ? "Restart play" : "Begin play");
}

/** A duration that does not flicker. */
const whole = (ms) => duration(Math.max(1, Math.round(ms / 1000)) * 1000).replace(".0 s", " s");

/** Whether the first state should have come, to the console and to this page. */
const stateDue = (link) => Date.now() - Math.max(now.opened, link.since * 1000 - clock.offset) > STATE_DUE_MS;

function banner() {
  const link = now.status?.link;
  const box = $("banner");
  let said = null;
  let since = "";
  let button = null;
  let title = "";
  if (!now.socket) {
    said = "The console does not answer. Retrying. If it was restarted, open its new link.";
    since = whole(Date.now() - (now.since ?? Date.now()));
  } else if (link && link.state !== "connected") {
    since = whole(Date.now() + clock.offset - link.since * 1000);
    if (link.state === "taken_over") {
      said = "Another program took the session over.";
      button = h("button", { onclick: () => ask("POST", "api/connection", {}) }, "Take it back");
    } else if (link.state === "silent") said = "The server does not answer. Waiting.";
    else if (!now.state) said = "Connecting to the server.";
    else said = now.status.address.startsWith("sim://") ? "The simulated server is gone. Starting another." : "The server is unreachable. Retrying.";
    title = link.reason;
  } else if (now.status && !now.status.playing) {
    said = "No play session is running.";
    button = h("button", { onclick: restartPlay }, "Begin play");
  } else if ((now.status?.mode === "live" || now.status?.running) && !now.state && !now.status.replay && stateDue(link)) {
    said = "No state arrives. Does the server publish it at another port (--state-port)?";
  }
  document.body.classList.toggle("stale", !now.socket || (link && !["connected", "taken_over"].includes(link.state)));
  box.hidden = said === null;
  // Over the lower edge of the page, which must not move when it goes. Without play, the page is empty, and it stays.
  box.classList.toggle("floating", since !== "");
  if ((box.dataset.said ?? "") !== (said ?? "")) {
    announce(said ?? (box.dataset.said ? "Connected." : ""));
    box.dataset.said = said ?? "";
    box.replaceChildren(h("span", { title }, said ?? ""), h("span", { class: "num" }), ...(button ? [button] : []));
  }
  if (box.children[1]) text(box.children[1], since && `for ${since}`);
}
