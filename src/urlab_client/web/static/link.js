// The connection to the console: one WebSocket that reconnects by itself, and calls over HTTP.

import { plain, toast } from "./dom.js";

const base = new URL(".", document.baseURI);
const listeners = new Map();

export const me = { viewer: "", name: "" };
export const clock = { offset: 0, best: Infinity };
const NAME = "urlab-name";
const PING_MS = 2000;
const SILENT_MS = 6000;
let socket = null;
let pause = 250;
let asked = null; // when the first ping was sent since the last message arrived

/** Call `listener` with each message of this type; `open` and `closed` report the connection itself. */
export function on(type, listener) {
  if (!listeners.has(type)) listeners.set(type, []);
  listeners.get(type).push(listener);
}

function tell(type, message) {
  for (const listener of listeners.get(type) ?? []) listener(message);
}

export function socketAt(path) {
  const url = new URL(path, base);
  url.protocol = url.protocol.replace("http", "ws");
  return new WebSocket(url);
}

export function connect() {
  asked = null;
  socket = socketAt("api/live");
  socket.onopen = () => {
    pause = 250;
    clock.best = Infinity;
    ping();
    tell("open");
  };
  socket.onmessage = (event) => {
    asked = null;
    const message = JSON.parse(event.data);
    if (message.type === "state") {
      // The console sends the next state once this one is drawn: a slow browser sees fewer states, not older ones.
      requestAnimationFrame(() => send({ type: "ack" }));
    } else if (message.type === "you") {
      me.viewer = message.viewer;
      me.name = sessionStorage.getItem(NAME) ?? message.name; // the same after the page is loaded again
      sessionStorage.setItem(NAME, me.name);
      if (me.name !== message.name) send({ type: "name", name: me.name });
    } else if (message.type === "pong") {
      const now = Date.now();
      const trip = now - message.at;
      if (trip <= clock.best) Object.assign(clock, { best: trip, offset: message.now - (now - trip / 2) });
    } else if (message.type === "refused") {
      toast(message.error.message);
    }
    tell(message.type, message);
  };
  socket.onclose = lost;
}

function lost() {
  socket.onclose = socket.onmessage = null;
  tell("closed");
  setTimeout(connect, pause);
  pause = Math.min(pause * 1.7, 4000);
}

export function send(message) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

/** Check that the console is alive: a stopped process closes no socket. */
function ping() {
  if (socket?.readyState !== WebSocket.OPEN) return;
  if (asked !== null && performance.now() - asked > SILENT_MS) {
    socket.close();
    lost();
    return;
  }
  asked ??= performance.now();
  send({ type: "ping", at: Date.now() });
}
setInterval(ping, PING_MS);

/** Send an HTTP request with a file or JSON; a failure that `refused` does not handle shows a toast and returns null. */
export async function ask(method, path, body, { quiet = false, refused = () => false } = {}) {
  let answer;
  try {
    answer = await fetch(new URL(path, base), {
      method,
      headers: { "x-urlab-viewer": me.viewer, ...(body instanceof Blob ? {} : { "content-type": "application/json" }) },
      body: body === undefined || body instanceof Blob ? body : JSON.stringify(body),
    });
  } catch {
    if (!quiet) toast("The console does not answer.");
    return null;
  }
  const said = await answer.json().catch(() => ({}));
  if (answer.ok) return said;
  if (!quiet && !refused(said.error)) toast([plain(said.error?.message ?? answer.statusText), said.error?.hint].filter(Boolean).join(" "));
  return null;
}

/** Upload a file; `told` is called with the progress, 0 to 1. A failure shows a toast and resolves to null. */
export function upload(path, file, told) {
  return new Promise((done) => {
    const request = new XMLHttpRequest();
    request.open("PUT", new URL(path, base));
    request.setRequestHeader("x-urlab-viewer", me.viewer);
    request.responseType = "json";
    request.upload.onprogress = ({ loaded, total }) => told(loaded / total);
    request.onerror = () => done(toast("The console does not answer.") ?? null);
    request.onload = () => {
      if (request.status < 300) return done(request.response ?? {});
      const { error } = request.response ?? {};
      toast([error?.message ?? request.statusText, error?.hint].filter(Boolean).join(" "));
      done(null);
    };
    request.send(file);
  });
}

export const op = (name, body = {}, options) => ask("POST", `api/ops/${name}`, body, options);

const pending = new Map();
let scheduled = false;

/** Make a function that sends its newest argument, one request at a time; a refusal, null, drops what waits. */
export function newest(send) {
  let sending = false;
  let waits = null;
  return async (value) => {
    waits = { value };
    if (sending) return;
    sending = true;
    while (waits) {
      const { value } = waits;
      waits = null;
      if ((await send(value)) === null) waits = null;
    }
    sending = false;
  };
}

/** Set a set-point; the newest of each is sent with the next animation frame. */
export function setPoint(articulation, actuator, value) {
  if (!pending.has(articulation)) pending.set(articulation, {});
  pending.get(articulation)[actuator] = value;
  if (scheduled) return;
  scheduled = true;
  requestAnimationFrame(() => {
    scheduled = false;
    send({ type: "ctrl", values: Object.fromEntries(pending) });
    pending.clear();
  });
}
