// Curves over the last seconds of simulation time: sensors, and each robot's joints and actuators.

import { Chart, ChartData, COLORS, LEAST_S } from "./chart.js";
import { $, h, heading } from "./dom.js";
import { ask, on } from "./link.js";

const SPANS = [2, 8, 30, 120];
const AXES = { 3: ["x", "y", "z"], 4: ["w", "x", "y", "z"] };
const KEPT_S = SPANS.at(-1);
const MISSED_MS = 500; // while a page opens it skips states again and again
const span = h("select", { id: "span", "aria-label": "Seconds of the curves", title: "Seconds of the curves; drag over a curve to enlarge a part of it", onchange: () => {
  enlarge(null);
  charts.forEach((chart) => chart.touch());
  if (replay) fill();
} },
  SPANS.map((seconds) => h("option", { value: seconds, selected: seconds === 8 }, `${seconds} s`)));
const part = h("option", { hidden: true, disabled: true });
const pause = h("button", { id: "pause-curves", "aria-pressed": "false", title: "Hold the curves, to scroll back; physics runs on", onclick: () => hold(!view.held) }, "❚❚ Hold");
const back = h("input", { type: "range", id: "scroll-back", min: 0, max: KEPT_S, step: "any", value: KEPT_S, "aria-label": "Scroll back", hidden: true,
  oninput: () => { view.end = view.last - (1 - back.value / KEPT_S) * Math.max(0, view.last - view.first - view.span); told(); } });
const probe = h("i", { hidden: true });

/**
 * Shared by all curves: the end of the time span (the newest state unless held), the pointer's position, the part that is
 * being marked, and the seconds of one that was enlarged. Curves that are held stay as they are when the simulation is
 * reset: what comes afterwards is kept apart.
 */
const view = { held: false, apart: false, end: 0, last: 0, first: 0, hover: null, marked: null, zoomed: null, chosen: 8, get span() { return this.zoomed ?? this.chosen; } };
/** What came, by curve: of the simulation, and of a recording. */
const kept = { live: new Map(), recorded: new Map() };
let all = []; // the sources of all curves, shown or not
let charts = [];
let replay = null;
let came = 0;
let newest = -1; // of the simulation's times
let filling = false;
let again = false;
let missed = Infinity; // the time after which the simulation's states are missing
let fetching = false;

const store = () => (replay ? kept.recorded : kept.live);

function dataOf(curves, signature) {
  if (!curves.has(signature)) curves.set(signature, new ChartData());
  return curves.get(signature);
}

/** Keep a state's values, of curves that are not shown for as long as the others span, so that one added is not empty. */
function take(state) {
  if (!state.recorded && state.time < newest) {
    kept.live = new Map();
    view.apart = view.held;
    if (!replay && !view.apart) connect();
  }
  if (!state.recorded) {
    if (newest < 0 || state.time > newest + LEAST_S) fetchMissed(newest);
    newest = state.time;
  }
  const curves = state.recorded ? kept.recorded : kept.live;
  const shown = new Set(charts.map((chart) => chart.signature));
  for (const source of all) {
    const own = state.articulations[source.art];
    const values = own && source.read(own);
    if (values) dataOf(curves, source.signature).add(state.time, values, shown.has(source.signature) ? KEPT_S : view.span);
  }
  if (curves !== store() || view.apart) return;
  if (!view.last || state.time < view.last) view.first = state.time;
  view.last = state.time;
  view.first = Math.max(view.first, view.last - KEPT_S);
  if (!view.held) charts.forEach((chart) => chart.touch());
}

/** Fetch the states of the simulation that this page has skipped, or that were before it was opened. */
async function fetchMissed(after) {
  missed = Math.min(missed, after);
  if (fetching) return;
  fetching = true;
  while (missed < Infinity) {
    await new Promise((go) => setTimeout(go, MISSED_MS));
    const [curves, since] = [kept.live, missed];
    missed = Infinity;
    const past = await ask("GET", `api/states?after=${since}`, undefined, { quiet: true });
    if (!past || curves !== kept.live) continue; // it was reset
    for (const source of all) {
      const found = past.states.filter((state) => state.time <= newest && state.articulations[source.art])
        .map((state) => [state.time, source.read(state.articulations[source.art])]).filter(([, values]) => values);
      dataOf(curves, source.signature).put(found.map(([time]) => time), found.map(([, values]) => values));
    }
    if (!replay && !view.apart) connect();
  }
  fetching = false;
}

/** Show what is kept. */
function connect() {
  const times = [...store().values()].map((data) => data.times).filter((times) => times.length);
  view.apart = false;
  view.last = Math.max(0, ...times.map((times) => times.at(-1)));
  view.first = Math.min(view.last, ...times.map((times) => times[0]));
  for (const chart of charts) {
    chart.data = dataOf(store(), chart.signature);
    chart.touch();
  }
}

/** Fill the curves with the states before the replay's position. */
async function fill() {
  again = true;
  if (filling) return;
  filling = true;
  while (again && replay) {
    again = false;
    const past = await ask("GET", `api/replay/states?seconds=${view.span}`, undefined, { quiet: true });
    if (!past || !replay) break;
    kept.recorded.clear();
    past.states.forEach(take);
    connect();
  }
  filling = false;
}

/** Whether a replay jumped to another time instead of continuing. */
function jumped(time) {
  const due = ((performance.now() - came) / 1000) * (replay?.rate ?? 1) + 0.5;
  came = performance.now();
  return time < view.last || time > view.last + due;
}

function hold(held) {
  if (view.apart) connect();
  enlarge(null);
  Object.assign(view, { held, end: view.last });
  pause.setAttribute("aria-pressed", held);
  pause.textContent = held ? "▶ Follow" : "❚❚ Hold";
  back.hidden = !held;
  back.value = KEPT_S;
  told();
}

/** Show a number of seconds that is not among the choices, or with null what was chosen. */
function enlarge(seconds) {
  if (seconds !== null) part.replaceChildren(`${seconds.toFixed(2)} s`);
  if (span.selectedOptions[0] !== part) view.chosen = +span.value;
  view.zoomed = seconds;
  if (seconds !== null) part.selected = true;
  else span.value = view.chosen;
}

/** Hold the curves and enlarge a part, from one time to another; or follow again. */
function zoom(part) {
  if (!part) return hold(false);
  if (!view.held) hold(true);
  const [from, to] = part;
  enlarge(to - from);
  view.end = to;
  const room = view.last - view.first - view.span;
  back.value = room > 0 ? KEPT_S * (1 - (view.last - to) / room) : KEPT_S;
  told();
}

/** Draw the curves over another time, and say which. */
function told() {
  back.setAttribute("aria-valuetext", `${(view.end - view.span).toFixed(2)} s to ${view.end.toFixed(2)} s`);
  charts.forEach((chart) => chart.touch());
}

/** Resolve a custom property to a colour for a canvas, in the active colour scheme. */
function resolved(name) {
  probe.style.color = `var(${name})`;
  return getComputedStyle(probe).color;
}

const single = (joint) => joint.kind === "hinge" || joint.kind === "slide";

/** Every curve of a robot: title, unit, names of its signals, and a function that reads its values. */
function sources(art) {
  const found = art.sensors.map((sensor) => ({
    key: `${art.key}/${sensor.name}`, title: sensor.name, kind: sensor.kind, unit: sensor.unit, shown: true,
    signals: sensor.dim === 1 ? [sensor.name] : AXES[sensor.dim] ?? [...Array(sensor.dim).keys()].map(String),
    read: (state) => state.sensors?.[sensor.name],
  }));
  for (const unit of ["rad", "m"]) {
    const joints = art.joints.filter((joint) => single(joint) && joint.unit === unit);
    if (!joints.length) continue;
    const what = unit === "rad" ? "joint angles" : "joint positions";
    found.push({ key: `${art.key}/qpos/${unit}`, title: what, kind: "joints", unit, signals: joints.map((joint) => joint.name),
      read: (state) => state.qpos && joints.map((joint) => state.qpos[joint.index]) });
    found.push({ key: `${art.key}/qvel/${unit}`, title: "joint velocities", kind: "joints", unit: `${unit}/s`, signals: joints.map((joint) => joint.name),
      read: (state) => state.qvel?.length ? joints.map((joint) => state.qvel[joint.dof]) : null });
  }
  if (art.actuators.length) {
    const pd = art.controller?.kind === "pd";
    const takes = new Set(art.actuators.map((actuator) => (pd ? "force" : actuator.takes)));
    const forces = takes.size === 1 && takes.has("force");
    found.push({ key: `${art.key}/ctrl`, title: forces ? "forces applied" : "controls applied", kind: "actuators", unit: forces ? "N m, N" : "",
      signals: art.actuators.map((actuator) => actuator.name), read: (state) => state.ctrl && art.actuators.map((actuator) => state.ctrl[actuator.index]) });
  }
  for (const actuator of art.actuators) {
    const joint = actuator.takes === "position" && art.joints.find((one) => one.name === actuator.joint && single(one));
    if (joint) found.push({ key: `${art.key}/follows/${actuator.name}`, title: `${actuator.name}: set-point and position`, kind: "actuators", unit: joint.unit, signals: ["set-point", "position"],
      read: (state) => state.targets && state.qpos ? [state.targets[actuator.index], state.qpos[joint.index]] : null });
  }
  return found.map((source) => ({ ...source, art: art.key, signature: JSON.stringify([source.key, source.signals, source.unit]) }));
}

export function makeSensors() {
  const grid = h("div", { class: "curves" });
  const add = h("select", { id: "add-curve", "aria-label": "Add a curve" });
  span.append(part);
  $("sensors").append(heading("Curves", h("span", { class: "space" }), add, span, pause), back, grid, probe);
  const chosen = new Map(JSON.parse(localStorage.getItem("urlab-curves") ?? "[]")); // key: whether it is shown

  function choose(key, wanted) {
    chosen.set(key, wanted);
    localStorage.setItem("urlab-curves", JSON.stringify([...chosen]));
    arrange();
  }

  function arrange() {
    const old = new Map(charts.map((chart) => [chart.signature, chart]));
    const robots = new Set(all.map((source) => source.art));
    charts = all.filter((source) => chosen.get(source.key) ?? source.shown).map((source) => {
      const { signature } = source;
      const chart = old.get(signature) ?? new Chart(source, view, dataOf(store(), signature), { close: () => choose(source.key, false), touchAll: () => charts.forEach((one) => one.touch()), zoom });
      chart.source = source;
      return chart;
    });
    grid.replaceChildren(...[...robots].flatMap((art) => {
      const own = charts.filter((chart) => chart.source.art === art).map((chart) => chart.element);
      return own.length && robots.size > 1 ? [h("h3", {}, art), ...own] : own;
    }));
    const rest = all.filter((source) => !(chosen.get(source.key) ?? source.shown));
    add.replaceChildren(h("option", { value: "" }, "Add a curve …"),
      ...rest.map((source) => h("option", { value: source.key }, `${source.art}: ${source.title}${source.unit && ` (${source.unit})`}`)));
    add.hidden = !rest.length;
    $("sensors").classList.toggle("empty", all.length === 0);
  }

  add.addEventListener("change", () => add.value && choose(add.value, true));
  on("world", ({ world }) => {
    all = world.articulations.flatMap(sources);
    const known = new Set(all.map((source) => source.signature));
    for (const curves of Object.values(kept)) for (const signature of [...curves.keys()]) if (!known.has(signature)) curves.delete(signature);
    arrange();
  });
  on("state", (state) => {
    if (state.recorded === (replay !== null)) {
      if (replay && state.time < view.last && view.held) hold(false);
      if (jumped(state.time) && replay) fill();
    }
    take(state);
  });
  on("status", (status) => {
    const other = status.replay?.name !== replay?.name;
    const halted = replay?.playing && !status.replay?.playing; // while it played, not every state came
    replay = status.replay;
    view.recorded = replay !== null; // of which a page that is slow skips states, and none is missing
    if (other) {
      kept.recorded.clear();
      connect();
    }
    if (replay && (other || halted)) fill();
  });
  const paint = () => {
    requestAnimationFrame(paint);
    if (!charts.some((chart) => chart.stale)) return;
    const colors = { grid: resolved("--line"), ink: resolved("--dim"), lines: COLORS.map(resolved) };
    for (const chart of charts) chart.draw(colors);
  };
  paint();
}
