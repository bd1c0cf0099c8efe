// Runs in MuJoCo's web viewer before its own code, and fits it into the console.
//
// - It requests its model and state at the root of its host; here they are beside the page.
// - It requests a model once and then gives up; here it retries until there is one, and again when the model changes.
// - It covers the picture with "DISCONNECTED" when a socket is down or no state arrives for a while; here a socket
//   reconnects by itself, the newest state is repeated, and the surrounding page reports the problem once.
// - It draws whenever it can; here not while it is out of sight, and only half of the time if drawing is slow:
//   the surrounding page shares the thread.
// - It neither exposes its camera nor accepts another one. Here the camera is ours (viewer_pointer.js) and overwrites
//   the viewer's before each frame. The selection and the overlays are written into each state likewise.
// - It takes the keyboard once it is clicked; here arrows move the camera, other keys go to the surrounding page.

{
  const beside = new URL(".", location.href);
  const OWN = /^\/(model|state|ui|drop)$/;
  const SLOW_MS = 25;
  const AGAIN_MS = 1000;
  const SHOWN = "state_ack";
  const LAYOUT = "layout=";
  const TAKEN = 4001; // "another page has MuJoCo's own panels"
  const CRC_AT = 8; // bytes into a state: the number of the model that it belongs to
  let wanted = 0; // the model that the newest state belongs to

  const moved = (address) => {
    const url = new URL(address, location.href);
    if (url.host !== location.host || !OWN.test(url.pathname)) return address;
    const found = new URL(url.pathname.slice(1) + url.search, beside);
    found.protocol = url.protocol;
    return found.href;
  };

  const ask = window.fetch.bind(window);
  window.fetch = (address, options) => ask(typeof address === "string" ? moved(address) : address, options);

  // Sockets

  const Real = window.WebSocket;
  const sockets = new Set();

  /** Stands in for the viewer's WebSocket. `name` is the last part of its address. */
  class Socket extends EventTarget {
    constructor(address) {
      super();
      this.url = moved(address);
      this.readyState = Real.CONNECTING;
      this.binaryType = "arraybuffer";
      this.bufferedAmount = 0;
      if (new URL(this.url).pathname.endsWith("/ui")) setTimeout(() => this.refuse());
      else this.join();
      this.newest = null;
      this.toldAt = 0;
      this.repeats = 0; // repeated states that are not yet acknowledged
      sockets.add(this);
    }

    /** Repeat the newest state before a frame if none has arrived for a while, however long that took. */
    repeat() {
      if (this.newest === null || (!viewerPointer.undressed && performance.now() - this.toldAt < AGAIN_MS)) return;
      viewerPointer.dress(this.newest);
      this.repeats += 1;
      this.toldAt = performance.now();
      this.tell("message", { data: this.newest });
    }

    /** Report that another page has MuJoCo's own panels. */
    refuse() {
      this.readyState = Real.CLOSED;
      sockets.delete(this);
      this.tell("close", { wasClean: true, code: TAKEN, reason: "this page watches" });
    }

    join() {
      const socket = (this.socket = new Real(this.url));
      socket.binaryType = "arraybuffer";
      socket.onopen = () => {
        if (this.readyState === Real.OPEN) return;
        this.readyState = Real.OPEN;
        this.tell("open", {});
      };
      socket.onmessage = ({ data }) => {
        if (typeof data === "string" && data.startsWith(LAYOUT)) {
          viewerPointer.learn(JSON.parse(data.slice(LAYOUT.length)));
          return;
        }
        if (data instanceof ArrayBuffer) {
          wanted = new DataView(data).getUint32(CRC_AT, true);
          this.newest = data;
          this.toldAt = performance.now();
          viewerPointer.dress(data);
        }
        this.tell("message", { data });
      };
      socket.onclose = () => this.readyState !== Real.CLOSED && setTimeout(() => this.join(), AGAIN_MS);
    }

    send(data) {
      if (data === SHOWN && this.repeats > 0) this.repeats -= 1;
      else if (this.socket?.readyState === Real.OPEN) this.socket.send(data);
    }

    close() {
      this.readyState = Real.CLOSED;
      sockets.delete(this);
      this.socket?.close();
    }

    tell(type, fields) {
      this[`on${type}`]?.(Object.assign(new Event(type), fields));
    }
  }
  for (const name of ["CONNECTING", "OPEN", "CLOSING", "CLOSED"]) Socket[name] = Real[name];
  window.WebSocket = Socket;

  // The model. Names that are not declared here are the viewer's own.

  let tried = 0;
  setInterval(() => {
    const started = typeof loadGeneration === "number" && loadGeneration > 0; // it has requested the model once
    const shown = started && currentModelCrc > 0 && (!wanted || currentModelCrc === wanted);
    if (started && !shown && foregroundLoads === 0 && performance.now() - tried > AGAIN_MS) {
      tried = performance.now();
      reloadModel(wanted);
    }
    if (shown) viewerPointer.seek(currentModelCrc);
    window.parent.postMessage({ viewer: shown ? "shown" : "loading", pointer: viewerPointer.found }, location.origin);
  }, 250);

  // Drawing

  const draw = window.requestAnimationFrame.bind(window);
  let seen = true;
  let waiting = [];
  let pause = 0;

  const next = (callback) => {
    const asked = performance.now();
    draw((now) => {
      sockets.forEach((socket) => socket.repeat());
      viewerPointer.aim();
      callback(now);
      const took = performance.now() - asked;
      pause = took > SLOW_MS ? Math.min(took, 500) : 0;
    });
  };
  window.requestAnimationFrame = (callback) => {
    if (!seen) waiting.push(callback);
    else if (pause) setTimeout(next, pause, callback);
    else next(callback);
    return 0;
  };
  new IntersectionObserver(([entry]) => {
    seen = entry.isIntersecting;
    if (seen) waiting.splice(0).forEach(next);
  }).observe(document.documentElement);

  // Keys

  for (const type of ["keydown", "keyup"]) {
    window.addEventListener(type, (event) => {
      event.stopImmediatePropagation();
      if (type === "keydown" && viewerPointer.key(event)) return event.preventDefault();
      const { key, code, ctrlKey, metaKey, altKey, shiftKey, repeat } = event;
      const again = new KeyboardEvent(type, { key, code, ctrlKey, metaKey, altKey, shiftKey, repeat, bubbles: true, cancelable: true });
      if (!window.parent.document.body.dispatchEvent(again)) event.preventDefault();
    }, true);
  }
}
