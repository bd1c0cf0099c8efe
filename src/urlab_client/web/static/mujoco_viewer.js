// Runs in MuJoCo's web viewer before its own code. That asks for its model and state at the root of a host of its own;
// here they lie beside the page. And it draws whenever it can; here not while it is out of sight, and where drawing is
// slow, only half of the time: the page around it shares the thread.

{
  const beside = new URL(".", location.href);
  const OWN = /^\/(model|state|ui|drop)$/;
  const SLOW_MS = 25;

  const moved = (address) => {
    const url = new URL(address, location.href);
    if (url.host !== location.host || !OWN.test(url.pathname)) return address;
    const found = new URL(url.pathname.slice(1) + url.search, beside);
    found.protocol = url.protocol;
    return found.href;
  };

  const ask = window.fetch.bind(window);
  window.fetch = (address, options) => ask(typeof address === "string" ? moved(address) : address, options);

  window.WebSocket = class extends WebSocket {
    constructor(address, protocols) {
      super(moved(address), protocols ?? []);
    }
  };

  const draw = window.requestAnimationFrame.bind(window);
  let seen = true;
  let waiting = [];
  let pause = 0;

  const next = (callback) => {
    const asked = performance.now();
    draw((now) => {
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
}
