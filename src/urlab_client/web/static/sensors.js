// Sensors as live curves over the last seconds of simulation time.

import { $, h, number, text } from "./dom.js";
import { on } from "./link.js";

const SPAN = 8;
const COLORS = ["--c1", "--c2", "--c3", "--c4", "--c5", "--c6"];
let curves = [];
const probe = h("i", { hidden: true });

/** A custom property as a colour that a canvas understands: of light and dark the one in force. */
function resolved(name) {
  probe.style.color = `var(${name})`;
  return getComputedStyle(probe).color;
}

class Curve {
  constructor(art, sensor) {
    this.art = art;
    this.name = sensor.name;
    this.dim = sensor.dim;
    this.points = [];
    this.canvas = h("canvas", {});
    this.shown = h("span", { class: "num" });
    this.element = h("div", { class: "curve", "data-sensor": `${art}/${sensor.name}` },
      h("div", { class: "line" }, h("b", {}, sensor.name), h("span", { class: "tag" }, sensor.kind), h("span", { class: "space" }), this.shown),
      this.canvas);
    this.seen = false;
    new IntersectionObserver(([entry]) => { this.seen = entry.isIntersecting; }).observe(this.canvas);
  }

  add(time, value) {
    const last = this.points.at(-1);
    if (last && time < last[0]) this.points = [];
    if (last && time === last[0]) return;
    this.points.push([time, value]);
    const cut = this.points.findIndex(([at]) => at >= time - SPAN);
    if (cut > 60) this.points.splice(0, cut);
    this.value = value;
  }

  draw(colors) {
    if (!this.seen || !this.value) return;
    text(this.shown, this.value.slice(0, 4).map((value) => number(value, 2)).join(" "));
    const ratio = devicePixelRatio;
    const width = Math.round(this.canvas.clientWidth * ratio);
    const height = Math.round(this.canvas.clientHeight * ratio);
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    const paint = this.canvas.getContext("2d");
    paint.clearRect(0, 0, width, height);
    let low = Infinity;
    let high = -Infinity;
    for (const [, value] of this.points) for (const one of value) { low = Math.min(low, one); high = Math.max(high, one); }
    const middle = (low + high) / 2;
    const half = Math.max((high - low) / 2, 0.02 * Math.abs(middle), 1e-3) * 1.12;
    const end = this.points.at(-1)[0];
    const x = (time) => width - ((end - time) / SPAN) * width;
    const y = (value) => height / 2 - ((value - middle) / half) * (height / 2);
    if (middle - half < 0 && middle + half > 0) {
      paint.strokeStyle = colors.grid;
      paint.lineWidth = ratio;
      paint.beginPath();
      paint.moveTo(0, y(0));
      paint.lineTo(width, y(0));
      paint.stroke();
    }
    paint.lineWidth = 1.6 * ratio;
    paint.lineJoin = "round";
    for (let i = 0; i < Math.min(this.dim, 12); i++) {
      paint.strokeStyle = colors.lines[i % colors.lines.length];
      paint.beginPath();
      for (const [time, value] of this.points) paint.lineTo(x(time), y(value[i]));
      paint.stroke();
    }
  }
}

export function makeSensors() {
  const grid = h("div", { class: "curves" });
  $("sensors").append(h("h2", {}, "Sensors", h("span", { class: "tag" }, `last ${SPAN} s`)), grid, probe);
  on("world", ({ world }) => {
    const old = new Map(curves.map((curve) => [`${curve.art}/${curve.name}/${curve.dim}`, curve]));
    curves = world.articulations.flatMap((art) => art.sensors.map((sensor) =>
      old.get(`${art.key}/${sensor.name}/${sensor.dim}`) ?? new Curve(art.key, sensor)));
    grid.replaceChildren(...world.articulations.flatMap((art) => {
      const own = curves.filter((curve) => curve.art === art.key).map((curve) => curve.element);
      return own.length && world.articulations.length > 1 ? [h("h3", {}, art.key), ...own] : own;
    }));
    $("sensors").classList.toggle("empty", curves.length === 0);
  });
  let changed = false;
  on("state", (state) => {
    for (const curve of curves) {
      const value = state.articulations[curve.art]?.sensors?.[curve.name];
      if (value) curve.add(state.time, value);
    }
    changed = true;
  });
  const paint = () => {
    requestAnimationFrame(paint);
    if (!changed) return;
    changed = false;
    const colors = { grid: resolved("--line"), lines: COLORS.map(resolved) };
    for (const curve of curves) curve.draw(colors);
  };
  paint();
}
