// Recording joint states, and playing them back.

import { $, h, text, toast } from "./dom.js";
import { on, op } from "./link.js";
import { now, run } from "./bar.js";

const record = h("button", { id: "record", onclick: toggle }, "● Record");
const sessions = h("select", { "aria-label": "Recording to play", id: "sessions" });
const play = h("button", { id: "replay", onclick: replay }, "▶ Replay");
const save = h("button", { class: "quiet", onclick: saveAs }, "Save");
const load = h("button", { class: "quiet", onclick: loadFrom }, "Load");
const file = h("input", { placeholder: "recording.json", "aria-label": "File on the server", size: 12 });
const line = h("progress", { max: 1, value: 0, "aria-label": "Place in the recording" });
const frame = h("span", { class: "num" });

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
    return;
  }
  if (sessions.value && (await op("replay_set_active", { name: sessions.value })) === null) return;
  if (now.status?.mode === "live" && (await op("set_mode", { mode: "direct" })) === null) return;
  if (await op("replay_start")) run(true);
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
  const chosen = sessions.value;
  sessions.replaceChildren(...(answer?.sessions ?? []).map((name) => h("option", {}, name)));
  if (chosen) sessions.value = chosen;
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
    line.value = at;
    text(frame, total ? `${at + 1} / ${total}` : "");
    line.parentElement.hidden = !total;
  });
}
