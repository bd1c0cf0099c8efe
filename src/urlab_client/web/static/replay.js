// The controls of a replay: position, in seconds of the recording's clock, and pace.

import { $, h, text } from "./dom.js";
import { ask, on } from "./link.js";
import { clockTime } from "./recording.js";

const PACES = [0.1, 0.25, 0.5, 1, 2, 4];
const line = h("input", { id: "timeline", type: "range", min: 0, max: 1, step: "any", value: 0, oninput: () => seek(+line.value),
  onkeydown: keys, "aria-label": "Position in the recording, seconds", title: "← → by 0.1 s, with Shift by 10 s" });
const name = h("b", { class: "name" });
const damage = h("span", { class: "tag", id: "damage" }, "incomplete");
const where = h("span", { class: "num", id: "replay-time" });
const play = h("button", { id: "replay-play", onclick: toggleReplay }, "▶");
const pace = h("select", { "aria-label": "Pace of the replay", onchange: () => ask("POST", "api/replay", { rate: +pace.value }) },
  PACES.map((rate) => h("option", { value: rate }, `${rate}×`)));
const placing = h("button", { class: "quiet", id: "placing", title: "Also place the simulation's robots: its cameras follow, and its mode is puppet meanwhile",
  onclick: togglePlacing }, "Also move the simulation");
const end = h("button", { id: "replay-end", class: "primary", onclick: () => ask("DELETE", "api/replay") }, "Back to live");
let replay = null;
let wanted = null;
let seeking = false;

function togglePlacing() {
  const { name, placing, time, playing, rate } = replay;
  return ask("POST", "api/replay", { name, placing: !placing, time, playing, rate });
}

export function toggleReplay() {
  return ask("POST", "api/replay", { playing: !replay?.playing });
}

export function pauseReplay() {
  return ask("POST", "api/replay", { playing: false });
}

/** Seek to a time; of the seeks requested while one is in flight, only the newest is sent. */
async function seek(to) {
  wanted = to;
  if (seeking) return;
  seeking = true;
  while (wanted !== null) {
    const next = wanted;
    wanted = null;
    await ask("POST", "api/replay", { time: next, playing: false });
  }
  seeking = false;
}

/** Handle arrow keys: the browser's own step is a hundredth of the recording, which is minutes in a long one. */
function keys(event) {
  const way = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[event.key];
  if (way === undefined) return;
  event.preventDefault();
  line.value = (wanted ?? replay.time) + way * (event.shiftKey ? 10 : 0.1);
  seek(+line.value);
}

export function makeReplay() {
  $("replay").append(h("span", { class: "tag" }, "Replay"), name, damage, play, line, where, pace, placing, end);
  on("status", (status) => {
    replay = status.replay;
    $("replay").hidden = replay === null;
    document.body.classList.toggle("replaying", replay !== null);
    document.body.classList.toggle("serverless", replay?.alone ?? false);
    // Controls of the simulation would act unseen, or not at all.
    const useless = replay !== null || ["lost", "connecting", "taken_over"].includes(status.link.state);
    for (const part of ["#robots", "#teleop", ".more"]) document.querySelector(part).inert = useless;
    if (!replay) return;
    text(name, replay.name.replace(/\.mcap$/, ""));
    damage.hidden = !replay.damage;
    damage.title = replay.damage;
    text(play, replay.playing ? "❚❚" : "▶");
    play.setAttribute("aria-label", replay.playing ? "Pause the replay" : "Play the replay");
    placing.setAttribute("aria-pressed", replay.placing);
    if (document.activeElement !== pace) pace.value = replay.rate;
    line.max = replay.seconds;
    const held = seeking || line.matches(":active");
    if (!held) line.value = replay.time;
    text(where, `${clockTime(held ? +line.value : replay.time)} of ${clockTime(replay.seconds)}`);
    line.setAttribute("aria-valuetext", where.textContent);
  });
}
