// The console: builds the page and handles the keyboard.

import { drive, makeBar, now, reset, step, stop, toggleRun } from "./bar.js";
import { makeCameras } from "./cameras.js";
import { $, h, toast } from "./dom.js";
import { makeLayout, resetLayout } from "./layout.js";
import { connect } from "./link.js";
import { makeLog } from "./log.js";
import { makeRecording } from "./recording.js";
import { makeReplay } from "./replay.js";
import { makeRobots } from "./robots.js";
import { makeContacts, makeScene } from "./scene.js";
import { makeSensors } from "./sensors.js";
import { makeTeleop } from "./teleop.js";
import { makeView } from "./view.js";

const KEYS = [
  [" ", "space", "play or pause", toggleRun],
  ["Escape", "esc", "stop; in a picture that is enlarged or on the whole screen, make it small", () => (document.fullscreenElement ? document.exitFullscreen() : stop())],
  [".", ".", "step (direct mode)", () => (now.status?.mode === "direct" ? step() : toast("Steps need mode direct."))],
  ["r", "r", "reset", () => reset($("keyframe").value)],
  ["d", "d", "take or release the controls", drive],
  ["?", "?", "show this help", () => $("help").showModal()],
];

for (const make of [makeBar, makeView, makeCameras, makeSensors, makeRobots, makeTeleop, makeScene, makeRecording, makeReplay, makeContacts, makeLog, makeLayout]) make();

$("help").append(h("h2", {}, "Keys"),
  h("dl", {}, ...KEYS.flatMap(([, shown, what]) => [h("dt", {}, h("kbd", {}, shown)), h("dd", {}, what)]),
    h("dt", {}, h("kbd", {}, "← →")), h("dd", {}, "move the focused slider"),
    h("dt", {}, h("kbd", {}, "w a s d")), h("dd", {}, "command a twist while the pad has focus")),
  h("p", { class: "hint" }, "Panels move by the grip at their top edge: drag it, or focus it and use the arrow keys."),
  h("form", { method: "dialog", class: "row" }, h("button", {}, "Close"), h("button", { id: "reset-layout", onclick: resetLayout }, "Reset the layout")));

// The target is the document itself when nothing has the focus.
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.repeat || document.querySelector("dialog[open]")) return;
  const field = event.target.closest?.("input:not([type=range], [type=checkbox]), select, textarea");
  const button = event.key === " " && event.target.closest?.("button, summary, [type=checkbox]");
  if ((field || button) && event.key !== "Escape") return;
  const found = KEYS.find(([key]) => key === event.key);
  if (!found) return;
  event.preventDefault();
  found[3]();
});

// A list keeps the focus after a choice and would swallow the keys above.
document.addEventListener("change", (event) => event.target.matches("select, input[type=file]") && event.target.blur());

connect();
