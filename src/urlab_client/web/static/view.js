// The 3-D view: MuJoCo's web viewer in a frame. The frame is loaded once there is a model and the view is open, and
// removed when the view is closed. Its cover shows what it waits for.

import { makeBodies, unpushable } from "./bodies.js";
import { showInstead } from "./cameras.js";
import { $, fullScreenButton, h, text } from "./dom.js";
import { on } from "./link.js";

const OPEN = "urlab-view";
const TOUCH = window.matchMedia("(pointer: coarse)");
const UPRIGHT = window.matchMedia("(orientation: portrait)");
const WITH_MOUSE = {
  look: "Drag to rotate, drag with the right button or Shift to pan, scroll to zoom. Click a body to select it. With the view in focus, the arrow keys rotate, with Shift they pan, + and − zoom.",
  push: " Press Push, or hold Ctrl, and drag a body to push it.",
};
const WITH_FINGERS = {
  look: "Drag to rotate; use two fingers to pan and zoom. Tap a body to select it.",
  push: " Press Push and drag a body to push it.",
};

/** The reason why this browser cannot show the view, or an empty string. */
function lacking() {
  if (!window.crossOriginIsolated) return "Browsers show the 3‑D view only on this machine or over HTTPS. A camera shows the scene instead.";
  if (!document.createElement("canvas").getContext("webgl2")) return "This browser has no WebGL 2, which the 3‑D view needs. A camera shows the scene instead.";
  return "";
}

export function makeView() {
  const cover = h("p", { class: "cover", role: "status" });
  const stage = h("div", { class: "stage" }, cover);
  const bodies = makeBodies(() => stage.querySelector("iframe")?.contentWindow);
  const screen = h("div", { class: "screen" }, bodies.bar, stage);
  bodies.bar.append(fullScreenButton("3-D view", () => screen));
  const hint = h("p", { class: "hint" });
  const instead = h("div", { class: "instead" });
  const box = h("details", { id: "view-box" }, h("summary", {}, h("h2", {}, "3-D view")), screen, instead, hint);
  $("view").append(box);
  const here = { socket: false, link: "connecting", missing: "", shown: false };
  const unable = lacking();
  hint.hidden = unable !== "";
  if (unable) showInstead(instead);

  /** The reason why there is no picture yet, or an empty string. */
  function waiting() {
    if (unable) return unable;
    if (!here.socket) return "Waiting for the console.";
    if (["connecting", "lost"].includes(here.link)) return "Waiting for the server.";
    return here.missing;
  }

  function show() {
    const why = waiting();
    let frame = stage.querySelector("iframe");
    // A loaded frame stays while the connection is lost: it shows the last state.
    const wanted = box.open && !unable && (frame ? !here.missing : !why);
    if (wanted && !frame) {
      here.shown = false;
      bodies.begun();
      frame = h("iframe", { src: "viewer/", title: "3-D view" });
      stage.prepend(frame);
    } else if (!wanted) frame?.remove();
    const said = wanted && here.shown ? "" : why || "Loading the model …";
    cover.hidden = !said;
    stage.classList.toggle("unable", unable !== "");
    bodies.bar.hidden = !wanted;
    cover.classList.toggle("busy", said !== "" && !unable && here.socket);
    text(cover, said);
  }

  const kept = localStorage.getItem(OPEN);
  box.open = kept === null ? true : kept === "yes";
  box.addEventListener("toggle", () => { localStorage.setItem(OPEN, box.open ? "yes" : "no"); show(); });
  window.addEventListener("message", ({ source, data }) => {
    if (!source || source !== stage.querySelector("iframe")?.contentWindow) return;
    if (data.viewer) {
      here.shown = data.viewer === "shown";
      show();
    }
    bodies.hear(data);
  });
  const explain = () => {
    const { look, push } = TOUCH.matches ? WITH_FINGERS : WITH_MOUSE;
    text(hint, here.alone ? look : look + (here.unpushable ? ` ${here.unpushable}` : push));
  };
  TOUCH.addEventListener("change", explain);
  explain();
  UPRIGHT.addEventListener("change", () => requestAnimationFrame(bodies.fit)); // a phone was turned
  on("open", () => { here.socket = true; show(); });
  on("closed", () => { here.socket = false; show(); });
  on("status", (status) => { here.link = status.link.state; here.alone = status.replay?.alone; here.unpushable = unpushable(status); show(); explain(); });
  on("world", ({ world }) => { here.missing = world.no_view; show(); });
  show();
}
