// Runs in MuJoCo's web viewer, before mujoco_viewer.js: its camera, selection, overlays and pointer input.
//
// The viewer does not expose its camera. It starts with the camera of the first state, so this finds its copies in
// memory by that value; if it finds none, the viewer's own mouse control stays, and nothing can be picked.

const viewerPointer = (() => {
  const STATIC_BYTES = 8 * 1024 * 1024; // where a program keeps its static data
  const CLICK_PIXELS = 4;
  const BAR = 32; // pixels below the picture, where MuJoCo's own bar is
  const TURN = 180; // degrees for a drag over the whole height
  const camera = { lookat: [0, 0, 0], distance: 3, azimuth: 90, elevation: -45 };
  const wanted = { select: -1, frames: false, contacts: false, pull: null };
  const pointers = new Map();
  let layout = null;
  let first = null; // the camera of the newest state, as the console sent it
  let places = [];
  let soughtIn = 0;
  let pushing = false; // drags push the selected body, without a key
  let drag = null;

  const tell = (message) => window.parent.postMessage(message, location.origin);
  const numbers = () => [...camera.lookat, camera.distance, camera.azimuth, camera.elevation];

  /** Find the viewer's cameras: all copies in memory of the first state's camera. */
  function seek(model) {
    if (soughtIn === model || !first || !layout) return;
    soughtIn = model;
    if (!places.length) {
      const memory = new Float64Array(wasmMemory.buffer, 0, STATIC_BYTES / 8);
      for (let at = 0; at < memory.length - 6; at += 1) {
        if (memory[at] === first[0] && first.every((value, i) => memory[at + i] === value)) places.push(8 * at);
      }
      const [x, y, z, distance, azimuth, elevation] = first;
      Object.assign(camera, { lookat: [x, y, z], distance, azimuth, elevation });
    }
    pointer.found = places.length > 0 && layout.camera !== undefined;
  }

  /** Overwrite the viewer's camera with ours. */
  function aim() {
    if (!pointer.found) return;
    const memory = new Float64Array(wasmMemory.buffer, 0, STATIC_BYTES / 8);
    for (const place of places) memory.set(numbers(), place / 8);
  }

  /** Write the selection and the overlays into a state. */
  function dress(data) {
    const view = new DataView(data);
    if (!layout) return;
    if (layout.camera !== undefined && !pointer.found) first = Array.from({ length: 6 }, (_, i) => view.getFloat64(layout.camera + 8 * i, true));
    const put = (name, value) => layout[name] !== undefined && view.setInt32(layout[name], value, true);
    put("select", wanted.select);
    put("frame", wanted.frames ? 1 : 0);
    put("active", wanted.pull ? 1 : 0);
    for (const at of layout.contacts ?? []) view.setUint8(at, wanted.contacts ? 1 : 0);
    if (wanted.pull && layout.localpos !== undefined && layout.refselpos !== undefined) {
      wanted.pull.local.forEach((value, i) => view.setFloat64(layout.localpos + 8 * i, value, true));
      wanted.pull.target.forEach((value, i) => view.setFloat64(layout.refselpos + 8 * i, value, true));
    }
    pointer.undressed = false;
  }

  // Geometry: MuJoCo's camera, z up

  function axes() {
    const a = (camera.azimuth * Math.PI) / 180;
    const e = (camera.elevation * Math.PI) / 180;
    const forward = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
    const right = [Math.sin(a), -Math.cos(a), 0];
    const up = [-Math.sin(e) * Math.cos(a), -Math.sin(e) * Math.sin(a), Math.cos(e)];
    return { forward, right, up };
  }
  const sum = (...terms) => [0, 1, 2].map((i) => terms.reduce((total, [factor, vector]) => total + factor * vector[i], 0));
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const height = () => window.innerHeight - BAR;
  const half = () => Math.tan(((layout?.fovy ?? 45) * Math.PI) / 360);
  const origin = () => sum([1, camera.lookat], [-camera.distance, axes().forward]);

  /** The ray through a point of the picture. */
  function ray(x, y) {
    const { forward, right, up } = axes();
    const v = (1 - (2 * y) / height()) * half();
    const u = ((2 * x) / window.innerWidth - 1) * half() * (window.innerWidth / height());
    return { origin: origin(), direction: sum([1, forward], [u, right], [v, up]) };
  }

  /** The intersection of a ray with the plane through a point that faces the camera. */
  function onPlane(point, { origin: from, direction }) {
    const { forward } = axes();
    return sum([1, from], [dot(sum([1, point], [-1, from]), forward) / dot(direction, forward), direction]);
  }

  function turn(dx, dy) {
    camera.azimuth -= (dx / height()) * TURN;
    camera.elevation = Math.max(-89.9, Math.min(89.9, camera.elevation - (dy / height()) * TURN));
  }

  function move(dx, dy) {
    const { right, up } = axes();
    const scale = (2 * half() * camera.distance) / height();
    camera.lookat = sum([1, camera.lookat], [-dx * scale, right], [dy * scale, up]);
  }

  function zoom(factor) {
    camera.distance = Math.max(0.02, Math.min(1e4, camera.distance * factor));
  }

  /** Handle a key as a drag or a turn of the wheel; return whether it was one. */
  function key({ key: name, shiftKey, ctrlKey, metaKey, altKey }) {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[name];
    if (!pointer.found || ctrlKey || metaKey || altKey || !(way || "+-=".includes(name))) return false;
    const step = height() / 24;
    if (!way) zoom(name === "-" ? 1.1 : 1 / 1.1);
    else if (shiftKey) move(step * way[0], step * way[1]);
    else turn(step * way[0], step * way[1]);
    return true;
  }

  /** Show a sphere. */
  function fit({ center, radius }) {
    const narrow = Math.atan(half() * Math.min(1, window.innerWidth / height()));
    Object.assign(camera, { lookat: [...center], distance: (1.05 * Math.max(radius, 0.05)) / Math.sin(narrow) });
  }

  // The pointer

  const grips = (event) => wanted.select > 0 && (pushing || event.ctrlKey || event.metaKey);

  function down(event) {
    window.parent.document.activeElement?.blur?.();
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    document.documentElement.setPointerCapture?.(event.pointerId);
    if (pointers.size > 1) {
      if (drag?.kind === "push") release();
      drag = { kind: "pinch" };
      return;
    }
    const at = [event.clientX, event.clientY];
    if (event.button === 0 && grips(event)) {
      drag = { kind: "push", at, grip: null };
      tell({ grip: ray(...at) });
    } else drag = { kind: event.button === 0 && !event.shiftKey ? "turn" : "move", at, from: at, button: event.button };
  }

  function moved(event) {
    const last = pointers.get(event.pointerId);
    if (!last || !drag) return;
    const next = [event.clientX, event.clientY];
    const [dx, dy] = [next[0] - last[0], next[1] - last[1]];
    if (drag.kind === "pinch") {
      const span = () => { const [[ax, ay], [bx, by]] = [...pointers.values()]; return Math.hypot(ax - bx, ay - by); };
      if (pointers.size < 2) return;
      const before = span();
      pointers.set(event.pointerId, next);
      zoom(before / Math.max(1, span()));
      move(dx / 2, dy / 2);
      return;
    }
    pointers.set(event.pointerId, next);
    drag.at = next;
    if (drag.kind === "push") pull();
    else if (drag.kind === "turn") turn(dx, dy);
    else move(dx, dy);
  }

  function up(event) {
    pointers.delete(event.pointerId);
    if (!drag) return;
    const still = drag.from && Math.hypot(drag.from[0] - event.clientX, drag.from[1] - event.clientY) < CLICK_PIXELS;
    if (drag.kind === "push") release();
    else if (still && drag.button === 0 && event.type === "pointerup") tell({ pick: ray(...drag.from) });
    if (!pointers.size || drag.kind !== "pinch") drag = null;
  }

  /** The page has found the gripped point of the body, in the body's frame and in the world. */
  function gripped(grip) {
    if (drag?.kind !== "push") return;
    drag.grip = grip;
    pull();
  }

  function pull() {
    if (!drag.grip) return;
    wanted.pull = { local: drag.grip.local, target: onPlane(drag.grip.point, ray(...drag.at)) };
    pointer.undressed = true;
    tell({ pull: wanted.pull });
  }

  function release() {
    wanted.pull = null;
    pointer.undressed = true;
    tell({ release: true });
  }

  function handled(type, act) {
    window.addEventListener(type, (event) => {
      if (!pointer.found) return;
      event.stopImmediatePropagation();
      if (event.cancelable) event.preventDefault();
      act(event);
    }, { capture: true, passive: false });
  }
  handled("pointerdown", down);
  handled("pointermove", moved);
  handled("pointerup", up);
  handled("pointercancel", up);
  handled("wheel", (event) => zoom(Math.exp(Math.sign(event.deltaY) * Math.min(0.25, Math.abs(event.deltaY) / 600))));
  for (const type of ["mousedown", "mousemove", "mouseup", "click", "dblclick", "contextmenu", "touchstart", "touchmove", "touchend", "touchcancel"]) {
    handled(type, () => {});
  }

  window.addEventListener("message", ({ source, data }) => {
    if (source !== window.parent) return;
    if (data.fit) fit(data.fit);
    if (data.grip) gripped(data.grip);
    if (data.pushing !== undefined) pushing = data.pushing;
    if (data.show) {
      Object.assign(wanted, data.show);
      pointer.undressed = true;
    }
  });

  const pointer = { found: false, undressed: false, learn: (one) => { layout = one; }, seek, aim, dress, ray, key };
  return pointer;
})();
