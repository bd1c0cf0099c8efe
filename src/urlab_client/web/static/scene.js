// The level: its actors, spawning, moving and removing them; and contacts.

import { $, choices, confirmed, h, heading, number, text, toast } from "./dom.js";
import { now } from "./bar.js";
import { ask, on, op } from "./link.js";
import { fold } from "./robots.js";

const actors = h("div", { class: "actors" });
const blueprint = h("select", { "aria-label": "Blueprint", id: "blueprint" });
const id = h("input", { "aria-label": "Name of the new actor", id: "actor-id", size: 8 });
const APART_M = 1;
const place = xyz([0, 0, 0], "new actor");
const yaw = h("input", { type: "number", step: 15, value: 0, "aria-label": "new actor: yaw, degrees" });
const file = h("input", { type: "file", accept: ".xml,.zip", hidden: true, id: "model-file", onchange: importModel });
const importing = h("button", { class: "quiet", title: "An MJCF file, or a ZIP archive of an MJCF file and its meshes", onclick: () => file.click() }, "Import a model …");
const warning = h("div", { class: "line warning", id: "no-manager", hidden: true },
  h("span", {}, "Play cannot begin: this level has no manager."),
  h("button", { id: "add-manager", onclick: async () => done(await op("ensure_manager")) }, "Add manager"));
const due = h("div", { class: "line warning", id: "edits-due", hidden: true }, "The level has changed since play began. “Restart play” shows it.");
const replacing = h("div", { class: "line warning", id: "would-replace", role: "alert", hidden: true });
/** Actors that the plugin itself needs; users do not place or remove them. */
const isManager = (actor) => /^A?Mj(Replay)?Manager$/.test(actor.class);
const managesPlay = (actor) => /^A?MjManager$/.test(actor.class);

function xyz(values, whose) {
  return values.map((value, i) => h("input", { type: "number", step: 0.1, value: +value.toFixed(3), "aria-label": `${whose}: ${"xyz"[i]}, metres` }));
}

const rows = new Map();
const EDITS = ["spawn_actor", "duplicate_actor", "destroy_actor", "set_actor_transform"];
let edited = false; // since play began
let playing = false;

function markEdits() {
  due.hidden = !(edited && playing);
  $("restart").classList.toggle("due", !due.hidden);
}
const read = (inputs) => inputs.map((input) => +input.value || 0);

function done(answer) {
  if (answer?.requires_pie_restart) toast("The level was changed. The change shows after “Restart play”.", "good");
  if (answer) refresh();
}

async function refresh() {
  const [list, blueprints] = await Promise.all([
    op("list_actors", {}, { quiet: true }),
    op("list_blueprints", {}, { quiet: true }),
  ]);
  $("scene").classList.toggle("empty", !list);
  if (!list) return;
  const seen = new Set();
  warning.hidden = list.actors.some(managesPlay);
  list.actors.filter((actor) => !isManager(actor)).forEach((actor, i) => {
    const key = JSON.stringify([actor.name, actor.actor_id]);
    seen.add(key);
    if (!rows.has(key)) rows.set(key, new Row(actor));
    const row = rows.get(key);
    row.update(actor);
    if (actors.children[i] !== row.element) actors.insertBefore(row.element, actors.children[i] ?? null);
  });
  for (const [key, row] of rows) {
    if (seen.has(key)) continue;
    row.element.remove();
    rows.delete(key);
  }
  choices(blueprint, (blueprints?.blueprints ?? []).map((one) => [one.blueprint_class_path, one.blueprint_short_name]));
  propose();
}

/** One actor of the list; the row lives as long as the actor, so that a field being edited keeps its text. */
class Row {
  constructor(actor) {
    const name = actor.actor_id || actor.name;
    const target = actor.actor_id ? { target: actor.actor_id } : { target: actor.name, target_by: "actor_name" };
    this.where = xyz(actor.location, name);
    this.yaw = h("input", { type: "number", step: 15, value: 0, "aria-label": `${name}: yaw, degrees` });
    this.element = h("div", { class: "actor", role: "group", "aria-label": name, "data-actor": name },
      h("span", { class: "name", title: actor.name }, name,
        h("span", { class: "tag" }, actor.is_light ? "light" : actor.is_articulation ? "robot" : "mesh")),
      h("span", { class: "acts" },
        h("button", { class: "quiet", title: "Move to this position and yaw", "aria-label": `Move ${name}`,
          onclick: () => this.move(target) }, "move"),
        actor.is_articulation ? h("button", { class: "quiet", title: "Spawn another one beside it", "aria-label": `Duplicate ${name}`,
          onclick: async () => done(await op("duplicate_actor", { ...target, new_actor_id: unused(name), location: free(read(this.where)) })) }, "duplicate") : null,
        confirmed({ class: "quiet", title: "Remove from the level", "aria-label": `Remove ${name}` }, "remove", "Remove?", async () => done(await op("destroy_actor", target)))),
      fields(this.where, this.yaw, () => this.move(target)));
  }

  async move(target) {
    done(await op("set_actor_transform", { ...target, location: read(this.where), rotation_quat: quaternion(this.yaw) }));
  }

  update(actor) {
    if ([...this.where, this.yaw].includes(document.activeElement)) return;
    this.where.forEach((input, i) => { input.value = +actor.location[i].toFixed(3); });
    const [, , z, w] = actor.rotation_quat;
    this.yaw.value = +((360 / Math.PI) * Math.atan2(z, w)).toFixed(1);
    this.location = actor.location;
  }
}

/** Position and yaw, each with its label; Enter does what the button beside them does. */
const fields = (where, yaw, enter) => h("span", { class: "fields", onkeydown: (event) => event.key === "Enter" && enter() },
  where.map((input, i) => h("label", {}, `${"xyz"[i]} `, input)), h("span", { class: "hint" }, "m"),
  h("label", {}, "yaw ", yaw), h("span", { class: "hint" }, "°"));

function quaternion(yaw) {
  const half = (Math.PI / 360) * (+yaw.value || 0);
  return [0, 0, Math.sin(half), Math.cos(half)];
}

/** The next free position along x. */
function free([x, y, z]) {
  const others = [...rows.values()].map((row) => row.location).filter(Boolean);
  const taken = (at) => others.some((other) => Math.hypot(other[0] - at, other[1] - y) < APART_M);
  while (taken(x)) x = +(x + APART_M).toFixed(3);
  return [x, y, z];
}

/** A free name for one more, which does not begin as another's does: some programs tell robots apart by that. */
function unused(name) {
  const stem = name.replace(/^copy\d+_/, "");
  for (let n = 1; ; n++) if (!document.querySelector(`[data-actor="copy${n}_${stem}"]`)) return `copy${n}_${stem}`;
}

/** Propose a name and a free position for the next actor, unless the user has typed one. */
function propose() {
  const chosen = blueprint.selectedOptions[0]?.text ?? "robot";
  id.placeholder = document.querySelector(`[data-actor="${chosen}"]`) ? unused(chosen) : chosen;
  if (place.some((input) => input.dataset.typed)) return;
  free([0, 0, 0]).forEach((value, i) => { place[i].value = value; });
}

async function spawn() {
  const answer = await op("spawn_actor", { blueprint: blueprint.value, actor_id: id.value || id.placeholder, location: read(place), rotation_quat: quaternion(yaw) });
  if (answer) {
    id.value = "";
    for (const input of place) delete input.dataset.typed;
  }
  done(answer);
}

function importModel() {
  const [chosen] = file.files;
  file.value = "";
  if (chosen) sendModel(chosen);
}

/** Import a file; `replace` names the blueprint that may be lost. */
async function sendModel(chosen, replace = "") {
  replacing.hidden = true;
  text(importing, "Importing …");
  const path = `api/models/${encodeURIComponent(chosen.name)}?replace=${encodeURIComponent(replace)}`;
  const answer = await ask("PUT", path, chosen, { refused: (error) => error?.code === "would_replace" && confirmReplacing(chosen, error) });
  text(importing, "Import a model …");
  if (!answer) return;
  toast(`${answer.name} can be spawned.`, "good");
  await refresh();
  blueprint.value = answer.blueprint;
  propose();
}

function confirmReplacing(chosen, { message, name }) {
  replacing.replaceChildren(h("span", {}, `${chosen.name}: ${message}`),
    h("span", { class: "acts" },
      h("button", { onclick: () => sendModel(chosen, name) }, `Replace ${name}`),
      h("button", { onclick: () => { replacing.hidden = true; } }, "Cancel")));
  replacing.hidden = false;
  return true;
}

export function makeScene() {
  for (const input of place) input.addEventListener("input", () => { input.dataset.typed = "yes"; });
  blueprint.addEventListener("change", propose);
  $("scene").append(heading("Scene", h("span", { class: "space" }), importing, file), warning, due, replacing, actors,
    h("div", { class: "spawn" }, h("h3", {}, "Add to the level"),
      h("span", { class: "fields" }, h("label", {}, "blueprint ", blueprint), h("label", {}, "name ", id)),
      fields(place, yaw, spawn), h("button", { id: "spawn", onclick: spawn }, "Spawn")));
  on("world", refresh);
  on("status", (status) => {
    playing = status.playing;
    markEdits();
  });
  on("log", ({ entries }) => {
    for (const { kind, what } of entries) {
      if (["play_started", "session_opened"].includes(what)) edited = false;
      else if (kind === "call" && EDITS.includes(what)) edited = true;
    }
    markEdits();
    if (entries.some((entry) => /^(spawn|destroy|set_actor|duplicate|ensure_manager|load_level|create_level|import)/.test(entry.what))) refresh();
  });
}

export function makeContacts() {
  const list = h("div", { class: "contacts" });
  const count = h("span", { class: "tag" });
  const box = fold("Contacts", false, list);
  box.firstChild.append(count);
  $("contacts").append(box);
  const look = async () => {
    if (box.open && !document.hidden && now.status?.playing && now.status.link.state === "connected") {
      const answer = await op("get_contacts", { max_contacts: 32 }, { quiet: true });
      text(count, answer ? `${answer.n_contacts}${answer.truncated ? "+" : ""}` : "");
      list.replaceChildren(...(answer?.contacts ?? []).map((contact) => h("div", { class: "line" },
        h("span", { class: "name" }, `${contact.geom1 || contact.body1} – ${contact.geom2 || contact.body2}`),
        h("span", { class: "num" }, `${number(contact.force[0], 1)} N`))));
      if (answer && !answer.n_contacts) list.replaceChildren(h("p", { class: "hint" }, "There are no contacts."));
    } else if (box.open && now.status?.link.state === "taken_over") list.replaceChildren(h("p", { class: "hint" }, "Contacts are told to whoever has the session."));
    setTimeout(look, 400);
  };
  box.addEventListener("toggle", () => box.open && list.childElementCount === 0 && list.append(h("p", { class: "hint" }, "Looking …")));
  look();
}
