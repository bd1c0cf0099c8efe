// Cameras: one WebSocket per visible camera. The console sends the next picture when the last one has been shown. While
// physics stands still, a visible camera fetches one picture for each change of the state.
// During a replay they show the recorded pictures; cameras that were not recorded stay live and are marked.

import { now, paused } from "./bar.js";
import { $, choices, duration, fullScreenButton, h, heading, text } from "./dom.js";
import { clock, on, socketAt } from "./link.js";
import { clockTime } from "./recording.js";

const views = new Map();
const STILL_MS = 1000;
const TICK_MS = 250;
const PIXELS = {
  real: "A picture in colour", depth: "Distances: near is bright", semantic: "One colour per class of object", instance: "One colour per object",
};

class CameraView {
  constructor(camera, owner) {
    this.camera = camera;
    const title = `${owner ? `${owner} / ` : ""}${camera.name}`;
    this.image = h("canvas", { width: camera.width, height: camera.height, role: "img", "aria-label": `Picture of ${title}` });
    this.larger = h("button", { class: "tiny", title: "Enlarge", "aria-label": `Enlarge ${title}`, "aria-pressed": false, onclick: () => this.enlarge() }, "⤢");
    this.note = h("span", { class: "num" }, "waiting");
    this.origin = h("span", { class: "origin" });
    this.replay = null;
    this.state = h("span", { class: "waiting" }, "No picture yet.");
    this.still = null; // the simulation time of a picture that was fetched, and when
    this.element = h("figure", { class: "camera", tabindex: -1, "data-camera": camera.path, onkeydown: (event) => this.key(event) }, // a click on it focuses it
      h("div", { class: "frame", onclick: () => this.enlarge() }, this.image, this.state),
      h("figcaption", {}, h("b", {}, title), h("span", { class: "tag", title: PIXELS[camera.mode] }, camera.mode), this.origin,
        h("span", { class: "space" }), this.note, fullScreenButton(title, () => this.element), this.larger));
    this.frames = [];
    this.closed = false;
    this.watcher = new IntersectionObserver(([entry]) => (entry.isIntersecting ? this.open() : this.shut()));
    this.watcher.observe(this.element);
  }

  open() {
    if (this.socket || this.closed) return;
    const socket = (this.socket = socketAt(`api/cameras/${this.camera.path}/live`));
    socket.binaryType = "arraybuffer";
    socket.onmessage = async ({ data }) => {
      const length = new DataView(data).getUint32(0, true);
      this.head = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
      await this.draw(new Blob([new Uint8Array(data, 4 + length)], { type: "image/jpeg" }));
      this.frames = [...this.frames.filter((at) => at > performance.now() - 1000), performance.now()];
      if (socket.readyState === WebSocket.OPEN) socket.send("shown");
    };
    socket.onclose = () => {
      if (this.socket !== socket) return;
      this.socket = null;
      setTimeout(() => this.element.isConnected && this.open(), 1000);
    };
  }

  shut() {
    const socket = this.socket;
    this.socket = null;
    socket?.close();
  }

  async draw(jpeg) {
    const bitmap = await createImageBitmap(jpeg);
    if (this.image.width !== bitmap.width || this.image.height !== bitmap.height) {
      Object.assign(this.image, { width: bitmap.width, height: bitmap.height });
    }
    this.image.getContext("2d").drawImage(bitmap, 0, 0);
    bitmap.close();
    this.label();
  }

  /** Fetch a picture of a state that stands still, as none is streamed then. */
  async fetchStill() {
    const { time } = now.state;
    if (time === this.still?.time || performance.now() - (this.still?.at ?? -Infinity) < STILL_MS) return;
    this.still = { time, at: performance.now() };
    text(this.state, "Taking a picture …");
    const jpeg = await fetch(`api/cameras/${this.camera.path}.jpg`).then((answer) => (answer.ok ? answer.blob() : null)).catch(() => null);
    if (!jpeg && this.still) this.still.time = null; // try again
    if (!jpeg || !paused() || this.replay) return;
    this.head = { received: Date.now() + clock.offset, sim_time: time, recorded: false };
    await this.draw(jpeg);
  }

  enlarge() {
    if (document.fullscreenElement) document.exitFullscreen();
    else if (!this.larger.isConnected) this.element.requestFullscreen?.(); // in the place of the 3-D view
    else this.larger.setAttribute("aria-pressed", this.element.classList.toggle("large"));
  }

  /** Escape makes an enlarged picture small, and then stops nothing. */
  key(event) {
    if (event.key !== "Escape" || !this.element.matches(".large")) return;
    event.stopPropagation();
    this.enlarge();
  }

  /** Show whether the picture is recorded; cover one that remains from a replay that has ended. */
  label() {
    const recorded = this.head?.recorded ?? false;
    const live = this.replay !== null && !this.replay.placing && !recorded && !this.replay.cameras.includes(this.camera.path);
    this.element.classList.toggle("still-live", live);
    text(this.origin, live ? "live, not recorded" : recorded && this.replay ? "recorded" : "");
    this.state.hidden = this.head !== undefined && (this.replay !== null || !recorded);
  }

  show(replay) {
    this.replay = replay;
    this.label();
  }

  tick() {
    if (!paused()) this.still = null;
    else if (this.socket && now.state && !this.replay) this.fetchStill();
    if (!this.head) return;
    if (this.head.recorded) {
      text(this.note, this.replay ? `at ${clockTime(this.head.sim_time)}` : "waiting");
      this.note.classList.remove("old");
      return;
    }
    const age = Date.now() + clock.offset - this.head.received;
    const rate = this.frames.filter((at) => at > performance.now() - 1000).length;
    text(this.note, age <= 1500 && (rate || !paused()) ? `${rate} fps · ${duration(age)}` : paused() ? "paused" : `${duration(age)} old`);
    this.note.classList.toggle("old", age > 1500 && now.status?.moving);
  }

  end() {
    this.closed = true;
    this.watcher.disconnect();
    this.shut();
  }
}

const SCENIC = /overview|side|scene|track|follow|front/i;

/** Show one camera of the world in `place`, for a browser that cannot draw the 3-D view. */
export function showInstead(place) {
  let view = null;
  let world = null;
  const list = h("select", { id: "camera-instead", "aria-label": "Camera instead of the 3-D view", onchange: show });
  const found = () => camerasOf(world).find(([{ path }]) => path === list.value);

  function show() {
    const [camera, owner] = found() ?? [];
    if (JSON.stringify(camera) === JSON.stringify(view?.camera)) return;
    view?.end();
    view = camera ? new CameraView(camera, owner) : null;
    view?.larger.remove();
    place.replaceChildren(...(view ? [list, view.element] : []));
  }

  on("world", (message) => {
    const before = list.options.length;
    world = message.world;
    const cameras = camerasOf(world);
    choices(list, cameras.map(([{ name, path }, owner]) => [path, owner ? `${owner} / ${name}` : name]));
    if (!before && cameras.length) list.value = (cameras.find(([{ name }]) => SCENIC.test(name)) ?? cameras[0])[0].path;
    show();
  });
  on("status", ({ replay }) => view?.show(replay));
  setInterval(() => view?.tick(), TICK_MS);
}

/** The cameras of the scene and of the robots, each with its owner. */
const camerasOf = (world) => [...world.cameras.map((camera) => [camera, ""]),
  ...world.articulations.flatMap((art) => art.cameras.map((camera) => [camera, art.key]))];

export function makeCameras() {
  const grid = h("div", { class: "cameras" });
  $("cameras").append(heading("Cameras"), grid);
  on("world", ({ world }) => {
    const wanted = new Map(camerasOf(world).map(([camera, owner]) => [camera.path, [camera, owner]]));
    for (const [path, view] of views) {
      const [camera] = wanted.get(path) ?? [];
      if (camera && JSON.stringify(camera) === JSON.stringify(view.camera)) continue;
      view.end();
      view.element.remove();
      views.delete(path);
    }
    for (const [path, [camera, owner]] of wanted) {
      if (views.has(path)) continue;
      const view = new CameraView(camera, owner);
      views.set(path, view);
      grid.append(view.element);
    }
    $("cameras").classList.toggle("empty", wanted.size === 0);
  });
  on("status", ({ replay }) => views.forEach((view) => view.show(replay)));
  setInterval(() => views.forEach((view) => view.tick()), TICK_MS);
}
