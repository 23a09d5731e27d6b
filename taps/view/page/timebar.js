// The time bar of a recording.

import { STATES } from "./colours.js";
import { $, clock, put } from "./panel.js";
import { COLUMNS } from "./world.js";

const PLAY = "M5 3l12 7-12 7z", STAND = "M5 3h3v14H5zm7 0h3v14h-3z";

export class TimeBar {
  constructor(link, world) {
    this.link = link;
    this.world = world;
    this.film = null;
    this.seen = new Map();   // state by part of the bar, where already played
    $("play").addEventListener("click", () => this.toggle());
    $("rate").addEventListener("change", () => link.say({ play: { speed: Number($("rate").value) } }));
    $("seek").addEventListener("input", () => { this.held = true; this.time(Number($("seek").value)); this.ask(); });
    $("seek").addEventListener("change", () => { this.held = false; });
    addEventListener("keydown", (event) => {
      if (!this.film || event.target.closest("input, select, dialog, button")) return;
      if (event.key === " ") { event.preventDefault(); this.toggle(); }
      const step = { ArrowLeft: -5, ArrowRight: 5 }[event.key];
      if (step) link.say({ play: { at: this.film.at + step } });
    });
  }

  toggle() { this.link.say({ play: { paused: !this.film.paused } }); }

  // A drag produces many seeks: send one at a time.
  ask() {
    if (this.asking) return;
    this.asking = setTimeout(() => { this.asking = 0; this.link.say({ play: { at: Number($("seek").value) } }); }, 60);
  }

  take(film) {
    this.film = film;
    $("timebar").hidden = false;
    const seek = $("seek");
    seek.min = film.t_first;
    seek.max = Math.max(film.t_last, film.t_first + 1e-3);
    if (!this.held && !this.asking) { seek.value = film.at; this.time(film.at); }  // an instant not yet asked for stays
    put("length", `${clock(film.t_last - film.t_first)}${film.error ? ": ends early" : film.done ? "" : " …"}`);
    $("length").title = film.error;
    const end = film.done && film.at >= film.t_last;
    $("play-path").setAttribute("d", film.paused || end ? PLAY : STAND);
  }

  time(at) { put("time", clock(at - this.film.t_first)); }

  draw(colours) {
    if (!this.film) return;
    const canvas = $("strip"), width = canvas.clientWidth, { t_first: first, t_last: last } = this.film;
    for (const row of this.world.rows) this.seen.set(Math.round(2 * row[0]), row[COLUMNS.state]);
    canvas.width = width;
    canvas.height = 8;
    const context = canvas.getContext("2d");
    context.fillStyle = colours.faint;
    context.globalAlpha = 0.35;
    context.fillRect(0, 0, width, 8);
    context.globalAlpha = 1;
    const part = width / Math.max(1e-3, last - first);
    for (const [half, state] of this.seen) {
      context.fillStyle = colours[STATES[state] || "none"];
      context.fillRect((half / 2 - first) * part, 0, Math.max(1, part / 2 + 0.5), 8);
    }
  }
}
