// Recordings: start and stop, and the files: download in several formats, replay, upload, deletion.

import { $, confirmed, h, heading, number, text, toast } from "./dom.js";
import { ask, on, upload } from "./link.js";

const record = h("button", { id: "record", title: "Record states, and pictures if chosen, into a file in the folder of the console", onclick: toggle }, "● Record");
const cameras = h("input", { type: "checkbox", id: "record-cameras", checked: true });
const progress = h("span", { class: "num", id: "record-progress" });
const list = h("div", { class: "recordings", id: "recordings" });
const file = h("input", { type: "file", accept: ".mcap,.json", hidden: true, onchange: open });
const OPEN = "Open a file …";
const opener = h("button", { class: "quiet", id: "upload", onclick: () => file.click() }, OPEN);
const DOWNLOAD = "Download";
let folder = "";

export function bytes(count) {
  const units = ["B", "KiB", "MiB", "GiB"];
  const power = Math.min(units.length - 1, Math.max(0, Math.floor(Math.log2(Math.max(1, count)) / 10)));
  return `${(count / 1024 ** power).toFixed(power ? 1 : 0)} ${units[power]}`;
}

/** Format seconds: 12.34 s, 3:05.1 min, 7:59:59 h. */
export function clockTime(seconds) {
  if (seconds < 60) return `${seconds.toFixed(2)} s`;
  const tenths = Math.floor(seconds * 10);
  const minutes = Math.floor(tenths / 600);
  if (minutes < 60) return `${minutes}:${((tenths % 600) / 10).toFixed(1).padStart(4, "0")} min`;
  const two = (value) => String(Math.floor(value)).padStart(2, "0");
  return `${Math.floor(minutes / 60)}:${two(minutes % 60)}:${two((tenths % 600) / 10)} h`;
}

let running = false;
async function toggle() {
  record.disabled = true;
  if (running) {
    const made = await ask("DELETE", "api/recording");
    if (made?.states) toast(`${made.name}: ${clockTime(made.seconds)}, ${bytes(made.bytes)}.`, "good");
    else if (made) {
      await ask("DELETE", at(made.name));
      toast("Nothing was recorded: no state came meanwhile. If physics stands still, press Play first.");
    }
    refresh();
  } else await ask("POST", "api/recording", { cameras: cameras.checked });
  record.disabled = false;
}

async function open() {
  const [chosen] = file.files;
  if (!chosen) return;
  opener.disabled = true;
  const made = await upload(at(chosen.name), chosen, (share) => text(opener, `Opening … ${Math.floor(share * 100)} %`));
  if (made) toast(`${chosen.name} was added.${made.damage && ` It is incomplete: ${made.damage}.`}`, "good");
  file.value = "";
  opener.disabled = false;
  text(opener, OPEN);
  refresh();
}

const at = (name) => `api/recordings/${encodeURIComponent(name)}`;

function row(recording) {
  const { name } = recording;
  const when = new Date(recording.at * 1000).toLocaleString([], { dateStyle: "short", timeStyle: "short" });
  const kinds = h("div", { class: "kinds" });
  const menu = h("details", { class: "menu" }, h("summary", { "aria-label": `Download ${name}` }, DOWNLOAD), kinds);
  const link = (label, query) => h("a", { href: at(name) + query, download: "", class: "kind" }, label);
  menu.addEventListener("toggle", async () => {
    if (!menu.open || kinds.childElementCount) return;
    const own = name.endsWith(".json") ? "JSON" : "MCAP";
    kinds.append(link(`${own}, as recorded`, ""), link("CSV, states as a table", "?as=csv"), link("NPZ, NumPy arrays", "?as=npz"));
    const about = await ask("GET", `${at(name)}?as=about`);
    const missing = about?.unavailable.mp4;
    if (about?.damage) kinds.append(h("p", { class: "hint" }, `Incomplete: ${about.damage}.`));
    for (const camera of missing ? [] : about?.cameras ?? []) {
      kinds.append(link(`MP4, ${camera}`, `?as=mp4&camera=${encodeURIComponent(camera)}`));
    }
    if (missing && about.cameras.length) kinds.append(h("p", { class: "hint" }, `MP4: ${missing}`));
  });
  const replay = h("button", { class: "replay", "aria-label": `Replay ${name}`, onclick: async () => {
    replay.disabled = true;
    text(replay, "Opening …");
    await ask("POST", "api/replay", { name });
    text(replay, "▶ Replay");
    replay.disabled = false;
  } }, "▶ Replay");
  return h("div", { class: "recorded", "data-recording": name },
    h("span", { class: "name", title: name }, name.replace(/\.mcap$/, "")),
    h("span", { class: "hint" }, `${when} · ${bytes(recording.bytes)}`),
    h("span", { class: "line" },
      replay, menu,
      confirmed({ class: "quiet", "aria-label": `Delete ${name}` }, "Delete", "Delete?", async () => {
        if (await ask("DELETE", at(name))) refresh();
      })));
}

let shown = "";
async function refresh() {
  const answer = await ask("GET", "api/recordings", undefined, { quiet: true });
  if (!answer) return;
  folder = answer.folder;
  const now = JSON.stringify(answer.recordings);
  if (now === shown) return;
  shown = now;
  list.replaceChildren(...answer.recordings.map(row));
  if (!answer.recordings.length) list.append(h("p", { class: "hint" }, `Recordings are stored in the folder “${folder}” on the console’s machine.`));
}

export function makeRecording() {
  $("recording").append(heading("Recordings"),
    h("div", { class: "line" }, record, h("label", { class: "check" }, cameras, " with cameras"), progress,
      h("span", { class: "space" }), opener, file),
    list);
  on("open", refresh);
  on("log", ({ entries }) => entries.some((entry) => /recording|record/.test(entry.what)) && refresh());
  on("status", (status) => {
    running = status.recording !== null;
    text(record, running ? "■ Stop recording" : "● Record");
    record.classList.toggle("danger", running);
    cameras.disabled = running;
    for (const one of list.querySelectorAll("[data-recording]")) {
      const making = status.conversions.find((conversion) => conversion.name === one.dataset.recording);
      text(one.querySelector("summary"), making ? `Preparing ${making.kind.toUpperCase()} … ${Math.floor(making.share * 100)} %` : DOWNLOAD);
    }
    progress.classList.toggle("old", running && status.recording.failed);
    text(progress, !running ? "" : status.recording.failed ? "cannot be written" : !status.recording.states ? "waiting for physics" : `${number(status.recording.seconds, 1).trim()} s · ${bytes(status.recording.bytes)}`);
  });
}
