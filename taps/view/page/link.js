// The WebSocket: connects, reconnects, delivers messages, and estimates the offset of the server's clock.

import { decode } from "./msgpack.js";

export const PROTOCOL = 1;
const PING_MS = 5000, UNANSWERED = 2, LAST_RETRY_MS = 5000, RELOAD_MS = 2000, TOKEN = "lumiloop-token", RELOADED = "lumiloop-reloaded";

export class Link {
  // told: callbacks {welcome, refused, frame, lost}.
  constructor(told) {
    this.told = told;
    this.page = document.querySelector("meta[name=lumiloop-page]").content;
    this.offset = 0;        // server's clock less ours, s
    this.trip = Infinity;   // round trip of the ping behind the offset, ms
    this.heard = -Infinity; // time of the server's last message, ms of this page
    this.retry = 250;
    this.token = token();
    addEventListener("visibilitychange", () => { if (!document.hidden && !this.socket) this.open(); });
    addEventListener("hashchange", () => {
      this.token = token();
      if (this.socket) this.socket.close();
      else this.open();   // it was refused without the right token
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
    this.beat = setInterval(() => this.ping(), PING_MS);   // also while connecting, which may take minutes
  }

  closed() {
    clearInterval(this.beat);
    this.socket = null;
    this.told.lost();
    if (this.refused !== "token") this.timer = setTimeout(() => this.open(), this.retry);
    this.retry = Math.min(2 * this.retry, LAST_RETRY_MS);
  }

  // Returns whether the message was sent: there may be no connection.
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

  // The page's version differs from the server's: show a notice and reload, once for each version.
  old(page) {
    this.refused = true;
    const again = sessionStorage.getItem(RELOADED) !== page;
    this.told.refused({ what: "version", text: again ? "This page is of another version of lumiloop; loading the right one."
      : "This page has another version of lumiloop than the server. Clear the browser's cache and load the page again." });
    sessionStorage.setItem(RELOADED, page);
    if (again) setTimeout(() => location.reload(), RELOAD_MS);
    else this.socket.close();
  }

  // A lost network does not close the socket for minutes: without answers, reconnect.
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
    this.offset = Math.abs(offset) < trip / 2000 ? 0 : offset;   // within the resolution: the same clock
  }
}

// Take the token from the URL and remove it there, or from this tab's storage.
function token() {
  const told = new URLSearchParams(location.hash.slice(1)).get("token");
  if (told) {
    sessionStorage.setItem(TOKEN, told);
    history.replaceState(null, "", location.pathname + location.search);
  }
  return told || sessionStorage.getItem(TOKEN);
}
