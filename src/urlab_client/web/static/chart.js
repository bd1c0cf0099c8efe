// One chart: several signals of one unit over time, with axes, a legend that hides signals, and values under the pointer.

import { h, number, text } from "./dom.js";

export const COLORS = ["--c1", "--c2", "--c3", "--c4", "--c5", "--c6"];
const DASHES = [[], [6, 3], [2, 2]]; // more signals than colours
const PAD = { left: 46, right: 6, top: 6, bottom: 16 };
const SHOWN_AT_FIRST = 6;
export const LEAST_S = 0.2;
const LEAST_DRAG = 8; // pixels
const GAP = 4; // times the mean distance

/** Values over time; cleared when time goes back. */
export class ChartData {
  constructor() {
    this.times = [];
    this.values = [];
  }

  add(time, values, kept) {
    const last = this.times.at(-1);
    if (time === last) return;
    if (time < last) [this.times, this.values] = [[], []];
    this.times.push(time);
    this.values.push(values);
    if (this.times[0] < time - 1.2 * kept) {
      const cut = this.at(time - kept);
      this.times.splice(0, cut);
      this.values.splice(0, cut);
    }
  }

  /** Put values of a time span in the place of those that are there. */
  put(times, values) {
    if (!times.length) return;
    const from = this.at(times[0]);
    const count = this.at(times.at(-1) + 1e-9) - from;
    this.times.splice(from, count, ...times);
    this.values.splice(from, count, ...values);
  }

  /** The index of the first value that is not before `time`. */
  at(time) {
    let [low, high] = [0, this.times.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.times[middle] < time) low = middle + 1;
      else high = middle;
    }
    return low;
  }
}

/** About `count` round numbers between two limits. */
function ticks(low, high, count) {
  const raw = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((size) => size >= raw) ?? raw;
  const found = [];
  for (let at = Math.ceil(low / step) * step; at <= high + step * 1e-9; at += step) found.push(at);
  return { found, digits: Math.max(0, -Math.floor(Math.log10(step) + 1e-9)) };
}

export class Chart {
  constructor(source, view, data, { close, touchAll, zoom }) {
    Object.assign(this, { source, view, data, signature: source.signature, stale: true, seen: false, scale: null, drawn: null });
    this.hidden = new Set(source.signals.slice(SHOWN_AT_FIRST).map((_, i) => i + SHOWN_AT_FIRST));
    this.canvas = h("canvas", { role: "img", "aria-label": `${source.title} over time${source.unit ? `, ${source.unit}` : ""}` });
    this.values = source.signals.map(() => h("span", { class: "num" }));
    const legend = h("div", { class: "legend" }, source.signals.map((name, i) => h("button", {
      class: "signal", "aria-pressed": !this.hidden.has(i), title: `Show or hide ${name}`,
      onclick: (event) => {
        if (!this.hidden.delete(i)) this.hidden.add(i);
        event.currentTarget.setAttribute("aria-pressed", !this.hidden.has(i));
        this.touch();
      },
    }, h("i", { class: `swatch s${i % COLORS.length}${i >= COLORS.length ? " dashed" : ""}` }), h("span", {}, name), this.values[i])));
    const fix = h("button", { class: "tiny", title: "Fix this y scale; what leaves it is cut off", "aria-label": `Fix the y scale of ${source.title}`, "aria-pressed": "false",
      onclick: () => { this.scale = this.scale ? null : this.drawn; fix.setAttribute("aria-pressed", this.scale !== null); this.touch(); } }, "↕");
    this.element = h("div", { class: "curve", "data-sensor": source.key },
      h("div", { class: "line" }, h("b", {}, source.title), h("span", { class: "tag" }, source.unit), h("span", { class: "space" }), fix,
        h("button", { class: "tiny", title: `Remove ${source.title}`, "aria-label": `Remove ${source.title}`, onclick: close }, "×")),
      this.canvas, legend);
    new IntersectionObserver(([entry]) => { this.seen = entry.isIntersecting; this.stale = true; }).observe(this.canvas);
    const share = (event) => (event.offsetX - PAD.left) / (this.canvas.clientWidth - PAD.left - PAD.right);
    const time = (at) => this.end - (1 - Math.min(1, Math.max(0, at))) * this.span;
    let began = null; // where a drag began: pixel and time
    this.canvas.addEventListener("pointerdown", (event) => {
      if (event.button !== 0 || event.pointerType === "touch") return; // fingers scroll the page
      began = { x: event.offsetX, time: time(share(event)) };
      this.canvas.setPointerCapture(event.pointerId);
    });
    this.canvas.addEventListener("pointermove", (event) => {
      const at = share(event);
      view.hover = at >= 0 && at <= 1 ? time(at) : null;
      const ends = began && Math.abs(event.offsetX - began.x) >= LEAST_DRAG ? [began.time, time(at)] : null;
      view.marked = ends && [Math.min(...ends), Math.max(...ends)];
      touchAll();
    });
    this.canvas.addEventListener("pointerup", () => { if (view.marked) zoom(view.marked); });
    this.canvas.addEventListener("lostpointercapture", () => { began = view.marked = null; touchAll(); });
    this.canvas.addEventListener("dblclick", () => zoom(null));
    this.canvas.addEventListener("pointerleave", () => { view.hover = null; touchAll(); });
  }

  get end() {
    return this.view.held ? this.view.end : this.data.times.at(-1) ?? 0;
  }

  /** Seconds across: fewer than chosen while there are fewer, so that a short replay fills its chart. */
  get span() {
    const there = this.end - (this.data.times[0] ?? 0);
    return this.view.held ? this.view.span : Math.min(this.view.span, Math.max(there, LEAST_S));
  }

  touch() {
    this.stale = true;
  }

  draw(colors) {
    if (!this.stale || !this.seen) return;
    this.stale = false;
    const { times, values } = this.data;
    if (!times.length) {
      this.canvas.getContext("2d").clearRect(0, 0, this.canvas.width, this.canvas.height);
      this.values.forEach((box) => text(box, ""));
      return;
    }
    const { hover } = this.view;
    const { end, span } = this;
    const [from, to] = [Math.max(0, this.data.at(end - span) - 1), this.data.at(end + 1e-9)];
    const shown = this.source.signals.map((_, i) => i).filter((i) => !this.hidden.has(i));
    const pointed = hover === null ? Math.max(0, to - 1) : Math.min(times.length - 1, this.data.at(hover));
    this.values.forEach((box, i) => text(box, number(values[pointed]?.[i], 3)));

    const ratio = devicePixelRatio;
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    if (this.canvas.width !== Math.round(width * ratio) || this.canvas.height !== Math.round(height * ratio)) {
      Object.assign(this.canvas, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
    }
    const paint = this.canvas.getContext("2d");
    paint.setTransform(ratio, 0, 0, ratio, 0, 0);
    paint.clearRect(0, 0, width, height);
    let [low, high] = this.scale ?? [Infinity, -Infinity];
    if (!this.scale) for (let k = from; k < to; k++) for (const i of shown) { low = Math.min(low, values[k][i]); high = Math.max(high, values[k][i]); }
    if (!Number.isFinite(low)) [low, high] = [-1, 1];
    this.drawn = [low, high];
    const middle = (low + high) / 2;
    const half = Math.max((high - low) / 2, 0.02 * Math.abs(middle), 1e-3) * 1.12;
    const x = (time) => PAD.left + (1 - (end - time) / span) * (width - PAD.left - PAD.right);
    const y = (value) => PAD.top + (1 - (value - middle + half) / (2 * half)) * (height - PAD.top - PAD.bottom);

    paint.font = "10px system-ui, sans-serif";
    paint.fillStyle = colors.ink;
    paint.strokeStyle = colors.grid;
    paint.lineWidth = 1;
    paint.textBaseline = "middle";
    const across = [3, 5, 8].map((count) => ticks(middle - half, middle + half, count)).find(({ found }) => found.length > 1);
    for (const value of across.found) {
      paint.textAlign = "right";
      paint.fillText(value.toFixed(across.digits).replace("-", "−"), PAD.left - 5, y(value));
      paint.beginPath(); paint.moveTo(PAD.left, y(value)); paint.lineTo(width - PAD.right, y(value)); paint.stroke();
    }
    const along = ticks(end - span, end, 4);
    paint.textAlign = "center";
    for (const time of along.found) {
      if (time < 0) continue;
      paint.fillText(`${time.toFixed(along.digits)} s`, Math.min(Math.max(x(time), PAD.left + 12), width - 14), height - 6);
      paint.beginPath(); paint.moveTo(x(time), PAD.top); paint.lineTo(x(time), height - PAD.bottom); paint.stroke();
    }
    if (this.view.marked) {
      const [left, right] = this.view.marked.map(x);
      paint.globalAlpha = 0.15;
      paint.fillRect(left, PAD.top, right - left, height - PAD.top - PAD.bottom);
      paint.globalAlpha = 1;
    }
    paint.save();
    paint.beginPath(); paint.rect(PAD.left, 0, width - PAD.left - PAD.right, height - PAD.bottom); paint.clip();
    paint.lineWidth = 1.6;
    paint.lineJoin = "round";
    // Where states did not come, there is no curve.
    const gap = this.view.recorded ? Infinity : Math.max(LEAST_S, (GAP * (times[to - 1] - times[from])) / Math.max(1, to - 1 - from));
    for (const i of shown) {
      paint.strokeStyle = colors.lines[i % colors.lines.length];
      paint.setLineDash(DASHES[Math.floor(i / COLORS.length) % DASHES.length]);
      paint.beginPath();
      for (let k = from; k < to; k++) {
        if (k > from && times[k] - times[k - 1] > gap) paint.moveTo(x(times[k]), y(values[k][i]));
        else paint.lineTo(x(times[k]), y(values[k][i]));
      }
      paint.stroke();
    }
    paint.setLineDash([]);
    if (hover !== null && to > 0) {
      paint.strokeStyle = colors.ink;
      paint.lineWidth = 1;
      paint.beginPath(); paint.moveTo(x(times[pointed]), PAD.top); paint.lineTo(x(times[pointed]), height - PAD.bottom); paint.stroke();
      paint.fillStyle = colors.ink;
      const left = x(times[pointed]) > width / 2;
      paint.textAlign = left ? "right" : "left";
      paint.fillText(`${times[pointed].toFixed(3)} s`, x(times[pointed]) + (left ? -4 : 4), PAD.top + 5);
    }
    paint.restore();
  }
}
