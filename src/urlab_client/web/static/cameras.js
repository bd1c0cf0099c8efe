// Cameras: one WebSocket per visible camera. The console sends the next picture when the last one has been shown.
// During a replay they show the recorded pictures; cameras that were not recorded stay live and are marked.

import { paused } from "./bar.js";
import { $, duration, h, text } from "./dom.js";
import { clock, on, socketAt } from "./link.js";
import { clockTime } from "./recording.js";

const views = new Map();

class CameraView {
  constructor(camera, owner) {
    this.camera = camera;
    this.image = h("canvas", { width: camera.width, height: camera.height });
    this.note = h("span", { class: "num" }, "waiting");
    this.origin = h("span", { class: "origin" });
    this.replay = null;
    this.state = h("span", { class: "waiting" }, "No picture yet. Cameras send pictures while physics runs live.");
    this.element = h("figure", { class: "camera", "data-camera": camera.path },
      h("div", { class: "frame", onclick: () => this.element.classList.toggle("large") }, this.image, this.state),
      h("figcaption", {}, h("b", {}, `${owner ? `${owner} / ` : ""}${camera.name}`), h("span", { class: "tag" }, camera.mode), this.origin,
        h("span", { class: "space" }), this.note));
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
      const bitmap = await createImageBitmap(new Blob([new Uint8Array(data, 4 + length)], { type: "image/jpeg" }));
      if (this.image.width !== bitmap.width || this.image.height !== bitmap.height) {
        Object.assign(this.image, { width: bitmap.width, height: bitmap.height });
      }
      this.image.getContext("2d").drawImage(bitmap, 0, 0);
      bitmap.close();
      this.label();
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

  /** Show whether the picture is recorded; cover one that remains from a replay that has ended. */
  label() {
    const recorded = this.head?.recorded ?? false;
    const live = this.replay !== null && !this.replay.placing && !recorded && !this.replay.cameras.includes(this.camera.path);
    this.element.classList.toggle("still-live", live);
    text(this.origin, live ? "live, not recorded" : recorded && this.replay ? "recorded" : "");
    this.state.hidden = this.head !== undefined && (this.replay !== null || !recorded);
  }

  tick() {
    if (!this.head) return;
    if (this.head.recorded) {
      text(this.note, this.replay ? `at ${clockTime(this.head.sim_time)}` : "waiting");
      this.note.classList.remove("old");
      return;
    }
    const age = Date.now() + clock.offset - this.head.received;
    const rate = this.frames.filter((at) => at > performance.now() - 1000).length;
    text(this.note, age <= 1500 ? `${rate} fps · ${duration(age)}` : paused() ? "paused" : `${duration(age)} old`);
    this.note.classList.toggle("old", age > 1500 && !paused());
  }

  end() {
    this.closed = true;
    this.watcher.disconnect();
    this.shut();
  }
}

export function makeCameras() {
  const grid = h("div", { class: "cameras" });
  $("cameras").append(h("h2", {}, "Cameras"), grid);
  on("world", ({ world }) => {
    const wanted = new Map();
    for (const art of world.articulations) for (const camera of art.cameras) wanted.set(camera.path, [camera, art.key]);
    for (const camera of world.cameras) wanted.set(camera.path, [camera, ""]);
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
  on("status", ({ replay }) => {
    for (const view of views.values()) {
      view.replay = replay;
      view.label();
    }
  });
  setInterval(() => views.forEach((view) => view.tick()), 250);
}
