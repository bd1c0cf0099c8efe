// Runs in MuJoCo's web viewer before its own code, and fits it into the console.
//
// - It asks for its model and state at the root of a host of its own; here they lie beside the page.
// - It asks for a model once and then gives up; here it asks again until there is one, and when it is another one.
// - It covers the picture with "DISCONNECTED" when a socket is down, or no state comes for a while; here a socket comes
//   back by itself, the newest state is told again, and the page around says what is wrong, once.
// - It draws whenever it can; here not while it is out of sight, and where drawing is slow, only half of the time:
//   the page around it shares the thread.
// - It neither tells where its camera is nor takes another one. Here the camera is ours (viewer_pointer.js), and is
//   written over its own before each frame. So are the selection and the overlays, into each state.
// - It takes the keyboard once it was clicked; here the page around it gets the keys, which are the console's.

{
  const beside = new URL(".", location.href);
  const OWN = /^\/(model|state|ui|drop)$/;
  const SLOW_MS = 25;
  const AGAIN_MS = 1000;
  const SHOWN = "state_ack";
  const LAYOUT = "layout=";
  const TAKEN = 4001; // "somebody else has MuJoCo's own panels"
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

  /** What the viewer takes for a socket. `name` is the last part of its address. */
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
      this.repeats = 0; // states that were told again, and not yet acknowledged
      sockets.add(this);
    }

    /** Tell the newest state again before a frame that would else find none for a while, however long that took. */
    repeat() {
      if (this.newest === null || (!viewerPointer.undressed && performance.now() - this.toldAt < AGAIN_MS)) return;
      viewerPointer.dress(this.newest);
      this.repeats += 1;
      this.toldAt = performance.now();
      this.tell("message", { data: this.newest });
    }

    /** MuJoCo's own panels are somebody else's, always. */
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
    const started = typeof loadGeneration === "number" && loadGeneration > 0; // it has asked once
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
      const { key, code, ctrlKey, metaKey, altKey, shiftKey, repeat } = event;
      const again = new KeyboardEvent(type, { key, code, ctrlKey, metaKey, altKey, shiftKey, repeat, bubbles: true, cancelable: true });
      if (!window.parent.document.body.dispatchEvent(again)) event.preventDefault();
    }, true);
  }
}
