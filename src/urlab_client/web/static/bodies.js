// Tools above the 3-D view: fit, overlays, and the selected body, which can be pushed.

import { choices, h, number, text, toast } from "./dom.js";
import { ask, on } from "./link.js";

const LOOK_MS = 300;
const RENEW_MS = 150;

/** Why bodies cannot be pushed now, or an empty string. */
export const unpushable = (status) => (status?.replay ? "A replay is shown. Go back to live to push."
  : status?.mode === "live" ? "In mode live a force lasts one physics step at most. To push, choose mode direct and press Play, or choose puppet." : "");

const PUSH = "Drag in the view to push the selected body; also with Ctrl held";

/** Make the tools; `frame` returns the viewer's window, or undefined. */
export function makeBodies(frame) {
  const say = (message) => frame()?.postMessage(message, location.origin);
  const here = { selected: -1, pushing: false, pull: null, sending: false, fitted: false, why: "" };
  const toggle = (id, label, title, act) => {
    const button = h("button", { id, title, "aria-pressed": "false", onclick: () => {
      const pressed = button.getAttribute("aria-pressed") !== "true";
      button.setAttribute("aria-pressed", pressed);
      act(pressed);
    } }, label);
    return button;
  };
  const fitted = h("button", { id: "fit", title: "Show all robots", onclick: fit }, "Fit");
  const contacts = toggle("show-contacts", "Contacts", "Contact points and forces", (one) => say({ show: { contacts: one } }));
  const frames = toggle("show-frames", "Frames", "Frames of the bodies: x red, y green, z blue", (one) => say({ show: { frames: one } }));
  const list = h("select", { id: "body", "aria-label": "Selected body", onchange: () => select(+list.value) });
  const push = toggle("push", "Push", PUSH, (one) => {
    here.pushing = one;
    say({ pushing: one });
  });
  const offer = () => {
    if (here.why && here.pushing) push.click();
    push.disabled = here.selected < 1 || here.why !== "";
    push.title = here.why || PUSH;
  };
  const facts = h("span", { class: "num", id: "body-facts" });
  const bar = h("div", { class: "row tools", role: "group", "aria-label": "3-D view" }, fitted, contacts, frames, list, push, facts);

  async function fit() {
    const found = await ask("GET", "api/bodies", undefined, { quiet: true });
    if (found) say({ fit: found });
    return found;
  }

  function select(id) {
    here.selected = id;
    list.value = id;
    offer();
    say({ show: { select: id } });
    look();
  }

  async function look() {
    if (here.selected < 1) return text(facts, "");
    const id = here.selected;
    const body = await ask("GET", `api/bodies/${id}`, undefined, { quiet: true });
    if (body && id === here.selected) text(facts, (facts.title = `${body.position.map((one) => number(one, 2)).join(" ")} m · ${+body.mass.toPrecision(3)} kg`));
  }

  async function fill() {
    const found = await fit();
    if (!found) return false;
    const named = found.bodies.map((one) => [String(one.id), [one.robot, one.name].filter(Boolean).join(" / ")]);
    choices(list, [["-1", "no body selected"], ...named]);
    select(named.some(([id]) => +id === here.selected) ? here.selected : -1);
    return true;
  }

  /** Send the newest pull, and repeat it while it is held: without renewal the console releases it. */
  async function send() {
    if (here.sending) return;
    here.sending = true;
    while (here.pull) {
      const sent = here.pull;
      const began = performance.now();
      if (await ask("POST", "api/push", { body: here.selected, ...sent }) === null) {
        here.pull = null;
        say({ show: { pull: null } });
        break;
      }
      if (here.pull === sent) await new Promise((go) => setTimeout(go, Math.max(0, RENEW_MS - (performance.now() - began))));
    }
    here.sending = false;
  }

  async function hear(data) {
    if (data.viewer) bar.classList.toggle("unable", !data.pointer);
    if (data.viewer === "shown" && data.pointer && !here.fitted) {
      here.fitted = true;
      here.fitted = await fill();
      for (const one of [contacts, frames, push]) one.setAttribute("aria-pressed", "false");
    }
    if (data.pick) {
      const found = await ask("POST", "api/pick", data.pick, { quiet: true });
      if (found) select(found.body?.id ?? -1);
    }
    if (data.grip && here.why) toast(here.why);
    else if (data.grip) {
      const found = await ask("POST", "api/pick", data.grip, { quiet: true });
      if (found?.body?.id === here.selected) say({ grip: { local: found.local, point: found.point } });
    }
    if (data.pull) {
      here.pull = data.pull;
      send();
    }
    if (data.release && here.pull) {
      here.pull = null;
      ask("DELETE", "api/push", undefined, { quiet: true });
    }
  }

  on("world", () => { here.fitted = false; });
  on("status", (status) => { here.why = unpushable(status); offer(); });
  setInterval(look, LOOK_MS);
  push.disabled = true;
  return { bar, hear, fit, begun: () => { here.fitted = false; } };
}
