// Recording joint states, and playing them back.

import { $, choices, h, text, toast } from "./dom.js";
import { ask, on, op } from "./link.js";
import { now, run } from "./bar.js";

const record = h("button", { id: "record", onclick: toggle }, "● Record");
const sessions = h("select", { "aria-label": "Recording to play", id: "sessions" });
const play = h("button", { id: "replay", onclick: replay }, "▶ Replay");
const save = h("button", { class: "quiet", onclick: saveAs }, "Save");
const load = h("button", { class: "quiet", onclick: loadFrom }, "Load");
const file = h("input", { placeholder: "recording.json", "aria-label": "File on the server", size: 12 });
const line = h("input", { id: "timeline", type: "range", min: 0, max: 1, step: 1, value: 0, disabled: true, oninput: () => seek(+line.value),
  "aria-label": "Place in the recording", title: "Drag to go to another place while it is replayed" });
const frame = h("span", { class: "num", id: "frame" });
let before = null; // the mode to go back to
let wanted = null;
let seeking = false;

async function toggle() {
  if (now.status?.recording) {
    const answer = await op("recording_stop");
    if (answer) toast(`${answer.frame_count} frames, ${answer.sim_duration_s.toFixed(1)} s of simulation.`, "good");
    refresh();
  } else await op("recording_start");
}

async function replay() {
  if (now.status?.replaying) {
    await op("replay_stop");
    if (before && before !== now.status.mode) await op("set_mode", { mode: before });
    before = null;
    return;
  }
  if (sessions.value && (await op("replay_set_active", { name: sessions.value })) === null) return;
  before = now.status?.mode ?? null;
  if (before === "live" && (await op("set_mode", { mode: "direct" })) === null) return;
  const answer = await op("replay_start");
  if (answer && !answer.total_frames) toast("This recording is empty.");
  else if (answer) run(true);
}

/** Go to a place; of those asked for while one is on its way, the newest. */
async function seek(to) {
  wanted = to;
  text(frame, `${to + 1} / ${+line.max + 1}`);
  if (seeking) return;
  seeking = true;
  while (wanted !== null) {
    const next = wanted;
    wanted = null;
    await ask("POST", "api/replay", { frame: next });
  }
  seeking = false;
}

async function saveAs() {
  const answer = await op("recording_save", file.value ? { path: file.value } : {});
  if (answer) toast(`Saved on the server: ${answer.absolute_path}`, "good");
}

async function loadFrom() {
  if (await op("replay_load", { path: file.value || "recording.json" })) refresh();
}

async function refresh() {
  const answer = await op("replay_list_sessions", {}, { quiet: true });
  choices(sessions, (answer?.sessions ?? []).map((name) => [name, name]));
}

export function makeRecording() {
  $("recording").append(h("h2", {}, "Recording"),
    h("div", { class: "line" }, record, sessions, play),
    h("div", { class: "line timeline" }, line, frame),
    h("div", { class: "line" }, file, save, load, h("span", { class: "hint" }, "on the server’s machine")));
  on("world", ({ world }) => world.playing && refresh());
  on("status", (status) => {
    text(record, status.recording ? "■ Stop recording" : "● Record");
    record.classList.toggle("danger", status.recording);
    text(play, status.replaying ? "■ Stop replay" : "▶ Replay");
    const [at, total] = status.replay ?? [0, 0];
    line.max = Math.max(1, total - 1);
    line.disabled = !status.replaying;
    if (!seeking && !line.matches(":active")) {
      line.value = at;
      text(frame, total ? `${at + 1} / ${total}` : "");
    }
    line.parentElement.hidden = !total;
  });
}
