// The state of the robot: the latest message of each topic, and its trajectory.

import { Tiles } from "./tiles.js";

const POSES = 64, TRAIL = 8000, STEP_M = 0.02, LEAP_M = 0.6, LOOPS = 200, ROWS = 1200, MARGIN_M = [2, 8];
export const COLUMNS = { t: 0, x: 1, y: 2, yaw: 3, sigma: 4, bound: 5, cycle: 6, late: 7, used: 8, state: 9, jumps: 10, map: 11 };

export class World {
  constructor() {
    this.tiles = new Tiles(() => { this.dirty = this.drawn = true; });
    this.scene = { mount: [0, 0, 0, false], lamps: [], states: {}, uses: {}, fixes: {}, loops: {}, stages: [], rungs: [] };
    this.forget();
  }

  // Another daemon, or another time of a recording.
  forget(keepTiles = false) {
    this.pose = this.lights = this.scan = this.statistics = null;
    this.poses = [];
    this.trail = [];
    this.loops = [];
    this.rows = [];
    this.faults = [];
    this.margin = MARGIN_M[0];
    this.box = null;         // of where the robot has been: x0, y0, x1, y1, m
    this.lampsPlaced = false;
    this.chosen = null;      // number of the lamp whose details are shown
    this.dirty = true;
    if (!keepTiles) this.tiles.clear();
  }

  // Returns whether the topic was one of these.
  take(topic, data) {
    const taken = this[`on_${topic}`];
    if (!taken) return false;
    taken.call(this, data);
    this.dirty = true;
    return true;
  }

  on_pose(data) {
    if (this.pose && data.map_id !== this.pose.map_id) this.lampsPlaced = false;
    this.pose = data;
    if (data.trust && data.trust.gap !== null) this.lampsPlaced = true;
    if (!data.pose) return;
    this.poses.push({ t: data.t_mono, pose: data.pose });
    if (this.poses.length > POSES) this.poses.shift();
    this.walk(data.pose, data.state, data.jumps, data.map_id);
  }

  on_lights(data) { this.lights = data; }
  on_scan(data) {
    this.scan = { ...data, ranges: floats(data.ranges) };
    const ranges = this.scan.ranges.filter((range) => range > 0.02 && range < Infinity).sort();
    this.margin = Math.max(this.margin, Math.min(MARGIN_M[1], ranges[ranges.length >> 1] || 0));
  }

  on_statistics(data) { this.statistics = data; }
  on_faults(data) { this.faults = data.present; }
  on_map(data) { this.tiles.take(data); }

  on_loops(loops) { this.loops = []; for (const one of loops) this.on_loop(one, -Infinity); }

  on_loop(data, since = performance.now()) {
    this.loops.push({ ...data, since });
    for (const at of [data.at_new, data.at_old]) if (at) this.include(at);
    if (this.loops.length > LOOPS) this.loops.shift();
  }

  on_history(rows) {
    this.rows = [];
    this.trail = [];
    for (const row of rows) this.on_row(row, true);
  }

  on_row(row, walked = false) {
    const last = this.rows[this.rows.length - 1];
    if (last && row[0] < last[0]) this.rows = [];
    this.rows.push(row);
    if (this.rows.length > ROWS) this.rows.shift();
    if (row[1] !== null && (walked || !this.pose)) this.walk([row[1], row[2], row[3]], row[9], row[10], row[11]);
  }

  on_rewound() { this.forget(true); }

  walk(pose, state, jumps, map) {
    const last = this.trail[this.trail.length - 1];
    if (last && last.map !== map) this.box = null;
    this.include(pose);
    const way = last ? Math.hypot(pose[0] - last.x, pose[1] - last.y) : Infinity;
    if (last && way < STEP_M && last.state === state) return;
    if (last && last.map !== map) this.trail = [];
    const torn = !last || way > LEAP_M || (last.jumps !== jumps && way > 0.1);
    this.trail.push({ x: pose[0], y: pose[1], state, jumps, map, torn });
    if (this.trail.length > TRAIL) this.trail.splice(0, TRAIL / 8);
  }

  // The robot has been there.
  include([x, y]) {
    const box = this.box || [x, y, x, y];
    this.box = [Math.min(box[0], x), Math.min(box[1], y), Math.max(box[2], x), Math.max(box[3], y)];
  }

  // The interpolated pose at a time; null: no poses.
  at(t) {
    const all = this.poses;
    if (!all.length) return null;
    let i = all.length - 1;
    while (i > 0 && all[i].t > t) i--;
    const a = all[i], b = all[i + 1];
    if (!b || t <= a.t) return carried(a, t, b ? null : this.pose.velocity);
    const part = (t - a.t) / (b.t - a.t);
    if (Math.hypot(b.pose[0] - a.pose[0], b.pose[1] - a.pose[1]) > 0.3) return b.pose;
    return a.pose.map((value, k) => value + part * (k === 2 ? turned(b.pose[2] - a.pose[2]) : b.pose[k] - value));
  }

  // Bounding box (x0, y0, x1, y1) of where the robot has been, m, with the room about it; null: not known.
  // The margin is the largest median range of a scan: beams through glass or a door are too few to change it.
  been() {
    if (!this.box) return null;
    const [x0, y0, x1, y1] = this.box, { margin } = this;
    return [x0 - margin, y0 - margin, x1 + margin, y1 + margin];
  }

  // The latest scan as points of the map, x and y alternating; null: no scan or no pose.
  points() {
    const scan = this.scan;
    if (!scan || !this.pose || !this.pose.pose || Math.abs(this.pose.t_mono - scan.t_mono) > 1) return null;
    const { ranges, bearing_first: first, bearing_step: step } = scan, n = ranges.length;
    const [mx, my, deg, inverted] = this.scene.mount, side = inverted ? -1 : 1, mount = deg * Math.PI / 180;
    const turn = this.pose.scan_rate ? Math.abs(n * step) / (2 * Math.PI * this.pose.scan_rate) : 0;
    const a = this.at(scan.t_mono), b = this.at(scan.t_mono + turn), yaw = turned(b[2] - a[2]);
    const points = new Float32Array(2 * n);
    let count = 0;
    for (let i = 0; i < n; i++) {
      const range = ranges[i];
      if (!(range > 0.02 && range < Infinity)) continue;
      const part = i / n, bearing = side * (first + i * step) + mount;
      const heading = a[2] + part * yaw, c = Math.cos(heading), s = Math.sin(heading);
      const x = mx + range * Math.cos(bearing), y = my + range * Math.sin(bearing);
      points[count++] = a[0] + part * (b[0] - a[0]) + c * x - s * y;
      points[count++] = a[1] + part * (b[1] - a[1]) + s * x + c * y;
    }
    return points.subarray(0, count);
  }

  stateName(number) { return (this.scene.states[number] || [String(number)])[0]; }
  useName(number) { return (this.scene.uses[number] || ["OTHER"])[0]; }
}

function carried(from, t, velocity) {
  const dt = t - from.t;
  if (!velocity || dt <= 0 || dt > 0.2) return from.pose;
  const [x, y, yaw] = from.pose, c = Math.cos(yaw), s = Math.sin(yaw);
  return [x + dt * (c * velocity[0] - s * velocity[1]), y + dt * (s * velocity[0] + c * velocity[1]), yaw + dt * velocity[2]];
}

export function turned(angle) { return Math.atan2(Math.sin(angle), Math.cos(angle)); }

function floats(bytes) {
  const copy = bytes.slice(0, bytes.length & ~3);
  return new Float32Array(copy.buffer, 0, copy.length / 4);
}
