// The WebSocket: opens it, opens it again when it is lost, tells what comes, and knows the server's clock.

import { decode } from "./msgpack.js";

export const PROTOCOL = 1;
const PING_MS = 5000, UNANSWERED = 2, LAST_RETRY_MS = 5000, RELOAD_MS = 2000, TOKEN = "lumiloop-token", RELOADED = "lumiloop-reloaded";

export class Link {
  // told: {welcome, refused, frame, lost}: what is called with what comes.
  constructor(told) {
    this.told = told;
    this.page = document.querySelector("meta[name=lumiloop-page]").content;
    this.offset = 0;        // server's clock less ours, s
    this.trip = Infinity;   // of the ping that said so
    this.heard = -Infinity; // when the server said anything last, ms of this page
    this.retry = 250;
    this.token = token();
    addEventListener("visibilitychange", () => { if (!document.hidden && !this.socket) this.open(); });
    addEventListener("hashchange", () => {
      this.token = token();
      if (this.socket) this.socket.close();
      else this.open();   // it was refused for want of the right one
    });
  }

  open() {
    clearTimeout(this.timer);
    if (this.socket) return;
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    this.refused = "";
    socket.onopen = () => this.say({ page: this.page, token: this.token });
    socket.onmessage = (event) => { this.heard = performance.now(); this.take(event.data); };
    socket.onclose = () => this.closed();
    this.unanswered = 0;
    this.beat = setInterval(() => this.ping(), PING_MS);   // also while it is being opened, which may take minutes
  }

  closed() {
    clearInterval(this.beat);
    this.socket = null;
    this.told.lost();
    if (this.refused !== "token") this.timer = setTimeout(() => this.open(), this.retry);
    this.retry = Math.min(2 * this.retry, LAST_RETRY_MS);
  }

  // Whether it went out: there may be no connection just now.
  say(words) {
    if (!this.socket || this.socket.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(words));
    return true;
  }

  // The server's time, s since the epoch.
  now() { return (performance.timeOrigin + performance.now()) / 1000 + this.offset; }

  use(text) {
    this.token = text;
    sessionStorage.setItem(TOKEN, text);
    this.refused = false;
    this.open();
  }

  take(data) {
    if (typeof data !== "string") {
      if (this.refused) return;
      for (const frame of decode(new Uint8Array(data))) this.frame(frame);
      return;
    }
    const words = JSON.parse(data);
    if (words.kind === "welcome") this.welcome(words);
    else if (words.kind === "pong") this.pong(words);
    else if (words.kind === "refused") {
      this.refused = words.what;
      this.told.refused(words);
    }
  }

  frame(frame) {
    if (frame.topic === "many") for (const one of frame.data) this.told.frame(one.topic, one.data);
    else this.told.frame(frame.topic, frame.data);
  }

  welcome(words) {
    if (words.page !== this.page || words.protocol !== PROTOCOL) {
      this.old(words.page);
      return;
    }
    sessionStorage.removeItem(RELOADED);
    this.retry = 250;
    this.trip = Infinity;
    this.unanswered = 0;
    this.ping();
    this.told.welcome(words);
  }

  // This page is of another version than the server: say so, and load the right one; once only for each.
  old(page) {
    this.refused = true;
    const again = sessionStorage.getItem(RELOADED) !== page;
    this.told.refused({ what: "version", text: again ? "This page is of another version of lumiloop; loading the right one."
      : "This page is of another version of lumiloop, and loading it anew has not helped: empty the browser's cache." });
    sessionStorage.setItem(RELOADED, page);
    if (again) setTimeout(() => location.reload(), RELOAD_MS);
    else this.socket.close();
  }

  // A network that has gone closes no socket for minutes: without answers it is given up and opened again.
  ping() {
    if (this.unanswered >= UNANSWERED) {
      const socket = this.socket;
      socket.onopen = socket.onmessage = socket.onclose = null;
      socket.close();
      this.closed();
      return;
    }
    this.unanswered += 1;
    this.say({ ping: performance.now() });
  }

  pong(words) {
    this.unanswered = 0;
    const trip = performance.now() - words.ping;
    if (trip > this.trip * 1.5 + 2) return;
    this.trip = Math.min(trip, this.trip);
    const offset = words.utc - (performance.timeOrigin + performance.now() - trip / 2) / 1000;
    this.offset = Math.abs(offset) < trip / 2000 ? 0 : offset;   // no farther apart than can be told: the same clock
  }
}

// The token out of the address, which then shows it no more, or as it was known before in this tab.
function token() {
  const told = new URLSearchParams(location.hash.slice(1)).get("token");
  if (told) {
    sessionStorage.setItem(TOKEN, told);
    history.replaceState(null, "", location.pathname + location.search);
  }
  return told || sessionStorage.getItem(TOKEN);
}
