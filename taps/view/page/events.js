// The list of events: states, faults, alerts, jumps, loop closures, maps, commands and lost connections.

import { $, clock, element, metres } from "./panel.js";
import { COLUMNS } from "./world.js";
import { STATES } from "./colours.js";

const KEPT = 300, SHOWN = 40;

export class Events {
  constructor(world) {
    this.world = world;
    this.first = null;       // begin of a recording, s; null: live
    this.forget();
  }

  forget() {
    this.all = [];           // {t, text, colour}, oldest first; t in s of the daemon's clock
    this.state = this.map = this.jumps = this.alert = null;
    this.faults = new Map();
    this.changed = true;
  }

  add(t, text, colour) {
    let at = this.all.length;
    while (at > 0 && this.all[at - 1].t > t) at--;
    this.all.splice(at, 0, { t, text, colour });
    if (this.all.length > KEPT) this.all.shift();
    this.changed = true;
  }

  // Now, on the daemon's clock; `utc`: s since the epoch.
  now(utc) { const pose = this.world.pose; return pose ? utc - pose.t_utc + pose.t_sent : 0; }

  on_history(rows) { for (const row of rows) this.on_row(row); }

  on_row(row) {
    this.enter(row[COLUMNS.t], row[COLUMNS.state], "");
    this.count(row[COLUMNS.t], row[COLUMNS.jumps], row[COLUMNS.map]);
  }

  on_state(data) { this.enter(data.t_mono, data.state, data.meaning); }

  on_pose(pose) {
    this.enter(pose.t_mono, pose.state, pose.reason ? pose.meaning : "");
    this.count(pose.t_mono, pose.jumps, pose.map_id);
    const trust = pose.trust || {}, alert = Boolean(trust.alert);
    if (this.alert !== null && this.alert !== alert) this.add(pose.t_mono, alert ? `Alert: protection level above ${metres(trust.limit_m)}` : "End of the alert", alert ? "bad" : "good");
    this.alert = alert;
  }

  // Messages of before this page was opened.
  on_past(list) { for (const one of list) this.on_faults(one); }

  on_faults({ present, t_mono }) {
    const { pose, rows } = this.world, now = new Map(present.map((one) => [one.fault, one]));
    const t = t_mono ?? (pose ? pose.t_mono : rows.length ? rows[0][COLUMNS.t] : null);
    if (t !== null) this.compare(now, t);
    this.faults = now;
  }

  // Faults that have appeared or gone since the last message.
  compare(now, t) {
    for (const [number, one] of now) if (!this.faults.has(number)) this.add(t, `Fault ${number}${one.cause ? ` (from ${one.cause})` : ""}: ${plain(one.meaning)}`, one.cause ? "dim" : "bad");
    for (const [number, one] of this.faults) if (!now.has(number)) this.add(t, `Fault ${number} cleared: ${plain(one.meaning)}`, "good");
  }

  on_loops(loops) { for (const one of loops) this.on_loop(one); }

  on_loop(data) {
    const why = this.world.scene.loops[data.reason], by = why && why[0] !== "OTHER" ? `, ${why[0].toLowerCase()}` : "";
    this.add(data.t_mono, `Loop closure: keyframe ${data.keyframe_new} to ${data.keyframe_old}${data.residual === null ? "" : `, residual ${metres(data.residual)}`}${by}`, "seek");
  }

  enter(t, state, meaning) {
    if (state === this.state) return;
    this.state = state;
    this.add(t, `${this.world.stateName(state).replace("_", " ")}${meaning ? `: ${plain(meaning)}` : ""}`, STATES[state] || "none");
  }

  count(t, jumps, map) {
    if (this.jumps !== null && jumps > this.jumps && map === this.map) this.add(t, `Jump of the pose (${jumps} in all)`, "warn");
    if (this.map !== null && map !== this.map && map) this.add(t, `Map ${map.toString(16).padStart(8, "0")} in use`, "accent");
    this.jumps = jumps;
    this.map = map;
  }

  time(t) {
    if (this.first !== null) return clock(t - this.first);
    const pose = this.world.pose;
    return pose ? new Date(1000 * (pose.t_utc - pose.t_sent + t)).toTimeString().slice(0, 8) : "";
  }

  show() {
    if (!this.changed || !this.world.pose) return;
    this.changed = false;
    const items = this.all.slice(-SHOWN).reverse().map(({ t, text, colour }) => {
      const item = element("li");
      item.dataset.colour = colour;
      item.append(element("time", "num", this.time(t)), element("span", "", text));
      return item;
    });
    $("events").replaceChildren(...items);
  }
}

const plain = (text) => (text || "").replaceAll("`", "");
