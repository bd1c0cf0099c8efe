// The log of calls, errors and events.

import { $, h } from "./dom.js";
import { on } from "./link.js";

export function makeLog() {
  const list = h("ol", { class: "entries" });
  const only = h("input", { type: "checkbox", onchange: () => list.classList.toggle("errors", only.checked) });
  $("log").append(h("h2", {}, "Log", h("span", { class: "space" }), h("label", { class: "hint" }, only, " errors only")), list);
  let newest = -1;
  on("closed", () => { newest = -1; list.replaceChildren(); });
  on("log", ({ entries }) => {
    const bottom = list.scrollTop + list.clientHeight > list.scrollHeight - 20;
    for (const entry of entries) {
      if (entry.n <= newest) continue;
      newest = entry.n;
      list.append(h("li", { class: entry.kind },
        h("time", {}, new Date(entry.at * 1000).toLocaleTimeString([], { hour12: false })),
        h("span", { class: "who" }, entry.who), h("b", {}, entry.what),
        h("span", { class: "said" }, entry.text === "{}" ? "" : entry.text),
        h("span", { class: "num" }, entry.ms == null ? "" : `${entry.ms.toFixed(1)} ms`)));
    }
    while (list.children.length > 300) list.firstChild.remove();
    if (bottom) list.scrollTop = list.scrollHeight;
  });
}
