// The level: what stands in it, spawning, moving, removing; and what touches what.

import { $, choices, confirmed, h, number, text, toast } from "./dom.js";
import { on, op } from "./link.js";
import { fold } from "./robots.js";

const actors = h("div", { class: "actors" });
const blueprint = h("select", { "aria-label": "Blueprint", id: "blueprint" });
const id = h("input", { placeholder: "id", "aria-label": "Actor id", id: "actor-id", size: 8 });
const place = xyz([0, 0, 0]);
const warning = h("div", { class: "line warning", id: "no-manager", hidden: true },
  h("span", {}, "This level has no manager, without which play cannot begin."),
  h("button", { id: "add-manager", onclick: async () => done(await op("ensure_manager")) }, "Add manager"));
/** Actors that the plugin itself needs; nobody places or removes them. */
const isManager = (actor) => /^A?Mj(Replay)?Manager$/.test(actor.class);
const managesPlay = (actor) => /^A?MjManager$/.test(actor.class);

function xyz(values) {
  return values.map((value, i) => h("input", { type: "number", step: 0.1, value: +value.toFixed(3), "aria-label": "xyz"[i] }));
}

const rows = new Map();
const read = (inputs) => inputs.map((input) => +input.value || 0);

function done(answer) {
  if (answer?.requires_pie_restart) toast("Done in the level. It shows after “Restart play”.", "good");
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
}

/** One actor of the list; it stays while the actor does, so that nobody loses what they are typing. */
class Row {
  constructor(actor) {
    this.where = xyz(actor.location);
    this.element = actorRow(actor, this.where);
  }

  update(actor) {
    if (this.where.includes(document.activeElement)) return;
    this.where.forEach((input, i) => { input.value = +actor.location[i].toFixed(3); });
  }
}

function actorRow(actor, where) {
  const target = actor.actor_id ? { target: actor.actor_id } : { target: actor.name, target_by: "actor_name" };
  return h("div", { class: "actor", "data-actor": actor.actor_id || actor.name },
    h("span", { class: "name", title: actor.name }, actor.actor_id || actor.name,
      h("span", { class: "tag" }, actor.is_light ? "light" : actor.is_articulation ? "robot" : "mesh")),
    h("span", { class: "group" }, ...where,
      h("button", { class: "quiet", title: "Move there", onclick: async () => done(await op("set_actor_transform", { ...target, location: read(where) })) }, "move"),
      confirmed({ class: "quiet", title: "Remove from the level" }, "remove", "Remove?", async () => done(await op("destroy_actor", target)))));
}

async function spawn() {
  if (!id.value) {
    toast("Give the actor an id first.");
    id.focus();
    return;
  }
  done(await op("spawn_actor", { blueprint: blueprint.value, actor_id: id.value, location: read(place) }));
}

export function makeScene() {
  $("scene").append(h("h2", {}, "Scene"), warning, actors,
    h("div", { class: "line spawn" }, blueprint, id, h("span", { class: "group" }, ...place),
      h("button", { id: "spawn", onclick: spawn }, "Spawn")));
  on("world", refresh);
  on("log", ({ entries }) => {
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
    if (box.open && !document.hidden && !document.body.classList.contains("stale")) {
      const answer = await op("get_contacts", { max_contacts: 32 }, { quiet: true });
      text(count, answer ? `${answer.n_contacts}${answer.truncated ? "+" : ""}` : "");
      list.replaceChildren(...(answer?.contacts ?? []).map((contact) => h("div", { class: "line" },
        h("span", { class: "name" }, `${contact.geom1 || contact.body1} – ${contact.geom2 || contact.body2}`),
        h("span", { class: "num" }, `${number(contact.force[0], 1)} N`))));
      if (answer && !answer.n_contacts) list.replaceChildren(h("p", { class: "hint" }, "Nothing touches anything."));
    }
    setTimeout(look, 400);
  };
  box.addEventListener("toggle", () => box.open && list.childElementCount === 0 && list.append(h("p", { class: "hint" }, "Looking …")));
  look();
}
