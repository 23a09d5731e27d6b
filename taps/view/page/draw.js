// Draws the map and, above it, robot, scan, lamps and loop closures.

import { colours, rgb, STATES, USES } from "./colours.js";

const FULL_TURN = 2 * Math.PI, ELLIPSE = 2.448, PULSE_MS = 2500;   // 2.448 deviations hold 95 % in a plane

export class Painter {
  constructor(base, over, world, camera) {
    this.base = base.getContext("2d", { alpha: false });
    this.over = over.getContext("2d");
    this.world = world;
    this.camera = camera;
    this.layers = { scan: true, links: true, trail: true, loops: true, bound: true };
    this.recolour();
  }

  recolour() {
    this.c = colours();
    this.shades = { wall: rgb(this.c.wall), free: rgb(this.c.free) };
    this.world.tiles.repaint();
  }

  resize(ratio) {
    for (const context of [this.base, this.over]) {
      context.canvas.width = Math.round(this.camera.width * ratio);
      context.canvas.height = Math.round(this.camera.height * ratio);
    }
    this.ratio = ratio;
  }

  below() {
    const context = this.base, { width, height } = this.camera;
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    context.fillStyle = this.c.bg;
    context.fillRect(0, 0, width, height);
    this.world.tiles.draw(context, this.camera, this.shades);
    this.grid(context);
  }

  grid(context) {
    const { camera } = this, [x0, y0, x1, y1] = camera.seen();
    const step = [1, 5, 10, 50, 100].find((m) => m * camera.scale >= 28) || 500;
    context.beginPath();
    for (let x = Math.ceil(x0 / step) * step; x < x1; x += step) line(context, [Math.round(camera.screen(x, 0)[0]) + 0.5, 0], [Math.round(camera.screen(x, 0)[0]) + 0.5, camera.height]);
    for (let y = Math.ceil(y0 / step) * step; y < y1; y += step) line(context, [0, Math.round(camera.screen(0, y)[1]) + 0.5], [camera.width, Math.round(camera.screen(0, y)[1]) + 0.5]);
    context.strokeStyle = this.c.grid;
    context.lineWidth = 1;
    context.stroke();
  }

  above(now) {
    const context = this.over, { world, layers } = this;
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    context.clearRect(0, 0, this.camera.width, this.camera.height);
    context.lineJoin = context.lineCap = "round";
    const pose = world.pose && world.pose.pose;
    let moving = false;
    if (layers.trail) this.trail(context);
    if (layers.loops) moving = this.loops(context, now);
    if (layers.links) this.lights(context, pose);
    if (layers.scan) this.scan(context);
    if (pose) this.robot(context, pose);
    if (this.camera.aim && this.camera.mode === "pose") this.arrow(context, this.camera.aim);
    if (this.camera.aim && this.camera.mode === "ruler") this.ruler(context, this.camera.aim);
    return moving;
  }

  trail(context) {
    const trail = this.world.trail, { camera } = this;
    context.lineWidth = 2;
    let i = 1;
    while (i < trail.length) {
      const state = trail[i].state;
      context.beginPath();
      context.moveTo(...camera.screen(trail[i - 1].x, trail[i - 1].y));
      for (; i < trail.length && trail[i].state === state; i++) {
        const at = camera.screen(trail[i].x, trail[i].y);
        if (trail[i].torn) context.moveTo(...at); else context.lineTo(...at);
      }
      context.strokeStyle = this.c[STATES[state] || "none"];
      context.stroke();
    }
  }

  loops(context, now) {
    let moving = false;
    for (const loop of this.world.loops) {
      if (!loop.at_new || !loop.at_old) continue;
      const a = this.camera.screen(...loop.at_new), b = this.camera.screen(...loop.at_old);
      const fresh = Math.max(0, 1 - (now - loop.since) / PULSE_MS);
      moving = moving || fresh > 0;
      context.strokeStyle = context.fillStyle = this.c.seek;
      context.globalAlpha = 0.7 + 0.3 * fresh;
      context.lineWidth = 1.5 + 3 * fresh;
      context.beginPath();
      line(context, a, b);
      context.stroke();
      for (const at of [a, b]) disc(context, at, 2.5 + 2 * fresh);
      if (fresh) {
        context.globalAlpha = fresh;
        context.beginPath();
        context.arc(...a, 8 + 42 * (1 - fresh), 0, FULL_TURN);
        context.stroke();
      }
    }
    context.globalAlpha = 1;
    return moving;
  }

  lights(context, pose) {
    const { world, camera } = this, links = new Map();
    for (const link of (world.lights && world.lights.links) || []) if (link.lamp_id !== null) links.set(link.lamp_id, link);
    if (!world.lampsPlaced) return;
    const strongest = Math.max(1e-12, ...[...links.values()].map((link) => link.strength));
    context.font = "600 11px system-ui, sans-serif";
    context.textAlign = "center";
    for (const [lamp, , x, y] of world.scene.lamps) {
      const at = camera.screen(x, y), link = links.get(lamp);
      const colour = link ? this.c[USES[world.useName(link.use)] || "faint"] : this.c.lamp;
      if (link && pose) {
        context.strokeStyle = colour;
        context.globalAlpha = 0.85;
        context.lineWidth = 1 + 3 * Math.sqrt(link.strength / strongest);
        context.setLineDash(world.useName(link.use) === "ACCEPTED" ? [] : [5, 5]);
        context.beginPath();
        line(context, at, camera.screen(pose[0], pose[1]));
        context.stroke();
        context.setLineDash([]);
      }
      context.globalAlpha = 1;
      context.fillStyle = this.c.lamp;
      context.strokeStyle = this.c["lamp-edge"];
      context.lineWidth = 1.5;
      const size = Math.max(4, Math.min(9, camera.scale * 0.1));
      disc(context, at, size);
      context.stroke();
      if (lamp === world.chosen) {
        context.strokeStyle = this.c.ink;
        context.lineWidth = 2;
        context.beginPath();
        context.arc(...at, size + 8, 0, FULL_TURN);
        context.stroke();
      }
      if (link) {
        context.strokeStyle = colour;
        context.lineWidth = 2;
        context.beginPath();
        context.arc(...at, size + 3, 0, FULL_TURN);
        context.stroke();
      }
      if (camera.scale > 14 || link) this.label(context, String(lamp), at[0], at[1] - size - 7);
    }
  }

  label(context, text, left, top) {
    context.lineWidth = 3;
    context.strokeStyle = this.c.bg;
    context.strokeText(text, left, top);
    context.fillStyle = this.c.ink;
    context.fillText(text, left, top);
  }

  scan(context) {
    const points = this.world.points(), { camera } = this;
    if (!points) return;
    const size = Math.max(2, Math.min(4, camera.scale * 0.05)), half = size / 2;
    context.fillStyle = this.c.scan;
    const { x: cx, y: cy, scale } = camera, w = camera.width / 2, h = camera.height / 2;
    for (let i = 0; i < points.length; i += 2) context.fillRect(w + (points[i] - cx) * scale - half, h - (points[i + 1] - cy) * scale - half, size, size);
  }

  robot(context, pose) {
    const { camera, world } = this, [x, y, yaw] = pose, at = camera.screen(x, y);
    const colour = this.c[STATES[world.pose.state] || "none"], bound = world.pose.trust && world.pose.trust.horizontal_m;
    if (this.layers.bound && bound) {
      context.beginPath();
      context.arc(...at, bound * camera.scale, 0, FULL_TURN);
      context.setLineDash([6, 5]);
      context.lineWidth = 1.5;
      context.strokeStyle = world.pose.trust.alert ? this.c.bad : this.c.accent;
      context.stroke();
      context.setLineDash([]);
    }
    if (world.pose.covariance) this.ellipse(context, at, world.pose.covariance, colour);
    const size = Math.max(10, 0.22 * camera.scale);
    context.save();
    context.translate(...at);
    context.rotate(-yaw);
    context.beginPath();
    context.moveTo(size, 0);
    context.lineTo(-0.75 * size, 0.68 * size);
    context.lineTo(-0.42 * size, 0);
    context.lineTo(-0.75 * size, -0.68 * size);
    context.closePath();
    context.fillStyle = colour;
    context.strokeStyle = this.c.card;
    context.lineWidth = 2;
    context.stroke();
    context.fill();
    context.restore();
  }

  ellipse(context, at, [xx, xy, yy], colour) {
    const mean = (xx + yy) / 2, apart = Math.hypot((xx - yy) / 2, xy);
    const major = Math.sqrt(Math.max(0, mean + apart)), minor = Math.sqrt(Math.max(0, mean - apart));
    const limit = 4 * Math.max(this.camera.width, this.camera.height), size = (m) => Math.min(limit, ELLIPSE * m * this.camera.scale);
    context.beginPath();
    context.ellipse(...at, size(major), size(minor), -0.5 * Math.atan2(2 * xy, xx - yy), 0, FULL_TURN);
    context.globalAlpha = 0.22;
    context.fillStyle = colour;
    context.fill();
    context.globalAlpha = 0.9;
    context.strokeStyle = colour;
    context.lineWidth = 1.5;
    context.stroke();
    context.globalAlpha = 1;
  }

  ruler(context, { from, to }) {
    const a = this.camera.screen(...from), b = this.camera.screen(...to);
    context.strokeStyle = context.fillStyle = this.c.accent;
    context.lineWidth = 2;
    context.beginPath();
    line(context, a, b);
    context.stroke();
    for (const at of [a, b]) disc(context, at, 4);
    const [dx, dy] = [to[0] - from[0], to[1] - from[1]], turn = 180 / Math.PI * Math.atan2(dy, dx);
    context.font = "600 13px system-ui, sans-serif";
    context.textAlign = "center";
    this.label(context, `${Math.hypot(dx, dy).toFixed(2)} m`, (a[0] + b[0]) / 2, (a[1] + b[1]) / 2 - 10);
    context.font = "12px system-ui, sans-serif";
    this.label(context, `Δx ${dx.toFixed(2)}, Δy ${dy.toFixed(2)} m, ${turn.toFixed(0)}°`, (a[0] + b[0]) / 2, (a[1] + b[1]) / 2 + 18);
  }

  arrow(context, { from, to }) {
    const at = this.camera.screen(...from), tip = this.camera.screen(...to);
    context.strokeStyle = context.fillStyle = this.c.accent;
    context.lineWidth = 3;
    disc(context, at, 6);
    if (Math.hypot(tip[0] - at[0], tip[1] - at[1]) < 6) return;
    context.beginPath();
    line(context, at, tip);
    context.stroke();
    context.save();
    context.translate(...tip);
    context.rotate(Math.atan2(tip[1] - at[1], tip[0] - at[0]));
    context.beginPath();
    context.moveTo(6, 0);
    context.lineTo(-9, 7);
    context.lineTo(-9, -7);
    context.fill();
    context.restore();
  }
}

function line(context, a, b) {
  context.moveTo(a[0], a[1]);
  context.lineTo(b[0], b[1]);
}

function disc(context, at, radius) {
  context.beginPath();
  context.arc(at[0], at[1], radius, 0, FULL_TURN);
  context.fill();
}
