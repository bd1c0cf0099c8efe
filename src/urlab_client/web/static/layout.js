// The layout: panels change places by their grips, dragged or with arrow keys, and stay there in this browser.

import { $, announce, h } from "./dom.js";

const KEPT = "urlab-layout";
const columns = [...document.querySelectorAll("main > .column")];
const panelsOf = (column) => [...column.querySelectorAll(":scope > section")];
const shownIn = (column) => panelsOf(column).filter((panel) => panel.offsetParent);
const atFirst = columns.map((column) => panelsOf(column).map((panel) => panel.id));
const mark = h("hr", { class: "drop" });

/** Move an element, and keep what it contains alive where the browser can: a frame would load again. */
function put(column, panel, before) {
  if (panel.isConnected && column.moveBefore) column.moveBefore(panel, before);
  else column.insertBefore(panel, before);
  column.parentElement.classList.toggle("alone", columns.some((one) => !panelsOf(one).length));
}

function arrange(wanted) {
  wanted.forEach((ids, i) => ids.forEach((id) => { const panel = $(id); if (panel?.matches("main section")) put(columns[i], panel, null); }));
}

function keep() {
  localStorage.setItem(KEPT, JSON.stringify(columns.map((column) => panelsOf(column).map((panel) => panel.id))));
}

function moveTo(panel, column, before) {
  put(column, panel, before);
  keep();
  const among = shownIn(column);
  announce(`${panel.getAttribute("aria-label")}: place ${among.indexOf(panel) + 1} of ${among.length}, column ${columns.indexOf(column) + 1}`);
}

/** The column and the panel before which a drop at this point goes. */
function target(x, y, moved) {
  const apart = (column) => { const { left, right } = column.getBoundingClientRect(); return Math.max(left - x, x - right, 0); };
  const column = columns.reduce((best, one) => (apart(one) < apart(best) ? one : best));
  const below = shownIn(column).find((one) => { const { top, height } = one.getBoundingClientRect(); return one !== moved && y < top + height / 2; });
  return [column, below ?? null];
}

function grip(panel) {
  let place = null; // where the panel goes when it is dropped
  const end = () => { place = null; mark.remove(); document.body.classList.remove("arranging"); };
  const button = h("button", {
    class: "grip", title: "Drag to move this panel, or use the arrow keys", "aria-label": `Move ${panel.getAttribute("aria-label")}`,
    onpointerdown: (event) => { button.setPointerCapture(event.pointerId); document.body.classList.add("arranging"); },
    onpointermove: (event) => {
      if (!button.hasPointerCapture(event.pointerId)) return;
      place = target(event.clientX, event.clientY, panel);
      place[0].insertBefore(mark, place[1]);
    },
    onpointerup: () => { const to = place; end(); if (to) moveTo(panel, ...to); },
    onpointercancel: end,
    onkeydown: (event) => {
      const column = panel.parentElement;
      const among = shownIn(column);
      const at = among.indexOf(panel);
      const sideways = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (event.key === "Escape" && place) { event.stopPropagation(); return end(); }
      if (event.key === "ArrowUp" && at > 0) moveTo(panel, column, among[at - 1]);
      else if (event.key === "ArrowDown" && at < among.length - 1) moveTo(panel, column, among[at + 1].nextElementSibling);
      else if (columns[columns.indexOf(column) + sideways]) {
        const beside = columns[columns.indexOf(column) + sideways];
        moveTo(panel, beside, shownIn(beside)[at] ?? null);
      } else return;
      event.preventDefault();
      button.focus();
      panel.scrollIntoView({ block: "nearest" });
    },
  });
  panel.prepend(button);
}

export function resetLayout() {
  arrange(atFirst);
  localStorage.removeItem(KEPT);
  announce("The panels are where they were at first.");
}

export function makeLayout() {
  try {
    arrange(JSON.parse(localStorage.getItem(KEPT)) ?? []);
  } catch {
    localStorage.removeItem(KEPT);
  }
  columns.flatMap(panelsOf).forEach(grip);
}
