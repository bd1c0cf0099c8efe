// The log of calls, errors and events, in words; immediate repetitions are counted.

import { $, h, text } from "./dom.js";
import { on } from "./link.js";

const KEPT = 300;
const plural = (names) => names.join(", ");

/** The text of each connection event. */
const EVENTS = {
  connected: () => "The console is connected to the server.",
  session_opened: (text) => `A session was opened${/mujoco_version ([^,]+)/.test(text) ? `; MuJoCo ${/mujoco_version ([^,]+)/.exec(text)[1]}` : ""}.`,
  play_started: (text) => `Play began${/\[(.*)\]/.test(text) ? ` with ${/\[(.*)\]/.exec(text)[1].replaceAll("'", "")}` : ""}.`,
  play_ended: () => "Play ended.",
  lost: () => "The server is unreachable.",
  reconnected: () => "The server is reachable again.",
  silent: () => "The server is not answering.",
  answers: () => "The server is answering again.",
  session_lost: () => "Another program took the session over.",
};

/** Words for an op and its arguments: `set_sim_speed {"percent":50}` is `set sim speed: percent 50`. */
function words(entry) {
  let given = entry.text;
  try {
    given = plural(Object.entries(JSON.parse(entry.text)).filter(([, value]) => value !== null)
      .map(([name, value]) => `${name.replaceAll("_", " ")} ${typeof value === "object" ? JSON.stringify(value) : value}`));
  } catch { /* it is a sentence */ }
  return given;
}

export function makeLog() {
  const list = h("ol", { class: "entries", "aria-label": "Log" });
  const only = h("input", { type: "checkbox", onchange: () => list.classList.toggle("errors", only.checked) });
  $("log").append(h("h2", {}, "Log", h("span", { class: "space" }), h("label", { class: "check hint" }, only, " errors only")), list);
  let newest = -1;
  let last = null; // the latest line: its text and count
  on("closed", () => { newest = -1; last = null; list.replaceChildren(); });

  function add(entry) {
    const event = entry.kind === "event";
    const said = event ? EVENTS[entry.what]?.(entry.text) ?? words(entry) : words(entry);
    const same = JSON.stringify([entry.kind, entry.who, entry.what, entry.kind === "error" ? said : null, event ? said : null]);
    if (last?.same === same) {
      last.times += 1;
      text(last.count, `×${last.times}`);
      text(last.said, said);
      return;
    }
    last = { same, times: 1, count: h("span", { class: "tag" }), said: h("span", { class: "said", title: `${entry.what} ${entry.text}` }, said) };
    list.append(h("li", { class: entry.kind },
      h("time", {}, new Date(entry.at * 1000).toLocaleTimeString([], { hour12: false })),
      h("span", { class: "who" }, entry.who), event ? null : h("b", {}, entry.what.replaceAll("_", " ")), last.said, last.count,
      h("span", { class: "num" }, entry.ms == null ? "" : `${entry.ms.toFixed(1)} ms`)));
  }

  on("log", ({ entries }) => {
    const bottom = list.scrollTop + list.clientHeight > list.scrollHeight - 20;
    for (const entry of entries) {
      if (entry.n <= newest) continue;
      newest = entry.n;
      add(entry);
    }
    while (list.children.length > KEPT) list.firstChild.remove();
    if (bottom) list.scrollTop = list.scrollHeight;
  });
}
