// The 3-D view: MuJoCo's web viewer in a frame. It is loaded when it is opened, and let go when it is closed.

import { $, h, text } from "./dom.js";
import { on } from "./link.js";

const OPEN = "urlab-view";

/** Why this browser cannot show it, or nothing. */
function lacking() {
  if (!window.crossOriginIsolated) return "browsers allow it on this machine and over https only";
  if (!document.createElement("canvas").getContext("webgl2")) return "this browser has no WebGL 2";
  return "";
}

export function makeView() {
  const box = h("details", { id: "view-box" }, h("summary", {}, "3-D view"));
  const why = h("p", { class: "hint" });
  const stage = h("div", { class: "stage" });
  box.append(stage, why);
  $("view").append(box);
  let missing = "there is nothing to show yet";

  const show = () => {
    text(why, missing ? `Nothing to see: ${missing}.` : "Drag to turn, with the right button to move, scroll for the distance.");
    stage.hidden = missing !== "";
    if (box.open && !missing) {
      if (!stage.firstChild) stage.append(h("iframe", { src: "viewer/", title: "3-D view" }));
    } else stage.replaceChildren();
  };

  const kept = localStorage.getItem(OPEN);
  box.open = kept === null ? matchMedia("(min-width: 901px)").matches : kept === "yes";
  box.addEventListener("toggle", () => { localStorage.setItem(OPEN, box.open ? "yes" : "no"); show(); });
  on("world", ({ world }) => {
    missing = world.no_view || lacking();
    show();
  });
  show();
}
