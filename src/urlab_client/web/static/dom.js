// Creating and finding elements, and formatting numbers.

/** Make an element: attributes, listeners (`onclick`), properties (`.value`), children. */
export function h(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name.startsWith(".")) element[name.slice(1)] = value;
    else if (name.startsWith("aria-") && value != null) element.setAttribute(name, value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value != null) element.setAttribute(name, value);
  }
  element.append(...children.flat().filter((child) => child != null));
  return element;
}

/** Fill a select with `[value, text]` options and keep the selection; an unchanged list is left alone. */
export function choices(select, wanted) {
  const before = [...select.options].map((option) => [option.value, option.text]);
  if (JSON.stringify(before) === JSON.stringify(wanted)) return;
  const chosen = select.value;
  select.replaceChildren(...wanted.map(([value, shown]) => h("option", { value }, shown)));
  if (wanted.some(([value]) => value === chosen)) select.value = chosen;
}

export const $ = (id) => document.getElementById(id);

/** Change text only if it differs: the page is updated sixty times a second. */
export function text(element, value) {
  if (element.textContent !== value) element.textContent = value;
}

/** Format a number with `digits` decimals and room for a sign. */
export function number(value, digits = 3) {
  if (value == null || !Number.isFinite(value)) return "–";
  const shown = Math.abs(value) < 0.5 * 10 ** -digits ? 0 : value;
  return (shown < 0 ? "−" : "\u2007") + Math.abs(shown).toFixed(digits);
}

/** An error without its code, which is for programs: `unknown_actor: no actor …`. */
export const plain = (message) => message.replace(/^[a-z]+(_[a-z]+)+: /, "");

export function duration(ms) {
  if (ms < 1000) return `${Math.max(0, Math.round(ms))} ms`;
  if (ms < 60000) return `${(ms / 1000).toFixed(1)} s`;
  return `${Math.floor(ms / 60000)} min ${Math.round((ms % 60000) / 1000)} s`;
}

/**
 * Make a button for an irreversible action: the first press shows a question in its place, and a second press within a
 * few seconds confirms it.
 */
export function confirmed(attributes, label, question, act) {
  const ASKED_MS = 4000;
  let timer = null;
  const settle = () => {
    clearTimeout(timer);
    timer = null;
    text(button, typeof label === "function" ? label() : label);
    button.classList.remove("danger");
  };
  const button = h("button", {
    ...attributes,
    onclick: () => {
      const asks = typeof question === "function" ? question() : question;
      if (timer !== null || !asks) {
        settle();
        act();
        return;
      }
      text(button, asks);
      button.classList.add("danger");
      timer = setTimeout(settle, ASKED_MS);
    },
    onblur: () => timer !== null && settle(),
  });
  settle();
  return button;
}

/** Make a panel's heading, whose title folds what stands below it; the browser remembers that. */
export function heading(title, ...rest) {
  const kept = `urlab-folded/${title}`;
  const button = h("button", { class: "fold", title: "Fold or unfold this panel", onclick: () => fold(!top.classList.contains("folded")) }, title);
  const top = h("h2", {}, button, ...rest);
  function fold(folded) {
    top.classList.toggle("folded", folded);
    button.setAttribute("aria-expanded", !folded);
    if (folded) localStorage.setItem(kept, "yes");
    else localStorage.removeItem(kept);
  }
  fold(localStorage.getItem(kept) !== null);
  return top;
}

/** Make a button that shows the element `shown()` on the whole screen, and again as before. */
export function fullScreenButton(of, shown) {
  return h("button", { class: "tiny full", title: "Full screen", "aria-label": `Full screen: ${of}`, hidden: !document.fullscreenEnabled,
    onclick: () => (document.fullscreenElement ? document.exitFullscreen() : shown().requestFullscreen()) }, "□");
}

/** Tell a screen reader what changed. */
export const announce = (message) => text($("announcements"), message);

/** Show a message for a while; one that is shown already stays for longer. */
export function toast(message, kind = "error") {
  [...$("toasts").children].find((one) => one.textContent === message)?.remove();
  const box = h("div", { class: `toast ${kind}` }, message);
  $("toasts").append(box);
  setTimeout(() => box.remove(), 6000);
  while ($("toasts").children.length > 4) $("toasts").firstChild.remove();
}
