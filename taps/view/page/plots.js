// Small plots of the last ten minutes.

import { COLUMNS } from "./world.js";
import { element } from "./panel.js";

const SPAN_S = 600, STATES = ["faint", "bad", "teal", "good", "warn", "seek", "bad", "seek"];
const PLOTS = [
  { title: "uncertainty", lines: [["sigma", "good", 100], ["bound", "accent", 100]], unit: "cm", names: ["σ", "bound"], least: 5 },
  { title: "computing a cycle", lines: [["cycle", "accent", 0.001]], unit: "ms", names: [""], least: 2 },
  { title: "pose published after", lines: [["late", "teal", 1000]], unit: "ms", names: [""], least: 20 },
  { title: "lamps used", lines: [["used", "lamp", 1]], unit: "", names: [""], least: 4 },
];

export class Plots {
  constructor(world, into) {
    this.world = world;
    this.all = PLOTS.map((plot) => {
      const box = element("div", "plot"), cap = element("div", "cap"), value = element("b"), canvas = element("canvas");
      cap.append(element("span", "", plot.title), value);
      box.append(cap, canvas);
      into.append(box);
      return { ...plot, box, value, canvas };
    });
  }

  draw(colours, ratio) {
    const rows = this.world.rows, last = rows[rows.length - 1];
    if (!last || document.hidden) return;
    const begin = Math.max(last[0] - SPAN_S, Math.min(rows[0][0], last[0] - 30));
    for (const plot of this.all) {
      plot.box.hidden = !rows.some((row) => plot.lines.some(([name]) => row[COLUMNS[name]]));
      if (!plot.box.hidden) this.one(plot, rows, begin, last, colours, ratio);
    }
  }

  one(plot, rows, begin, last, colours, ratio) {
    const { canvas } = plot, width = canvas.clientWidth, height = canvas.clientHeight, context = canvas.getContext("2d");
    if (!width) return;
    if (canvas.width !== Math.round(width * ratio)) { canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio); }
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const top = this.top(plot, rows), x = (t) => (t - begin) / Math.max(1, last[0] - begin) * width, y = (v) => height - 5 - v / top * (height - 14);
    this.states(context, rows, x, height, colours);
    context.strokeStyle = colours.grid;
    context.beginPath();
    for (const part of [0, 0.5, 1]) { context.moveTo(0, y(part * top)); context.lineTo(width, y(part * top)); }
    context.stroke();
    for (const [name, colour, factor] of plot.lines) {
      context.beginPath();
      let torn = true;
      for (const row of rows) {
        const value = row[COLUMNS[name]];
        if (value === null || row[0] < begin) { torn = true; continue; }
        const at = [x(row[0]), y(Math.min(top, value * factor))];
        if (torn) context.moveTo(...at); else context.lineTo(...at);
        torn = false;
      }
      context.strokeStyle = colours[colour];
      context.lineWidth = 1.5;
      context.stroke();
    }
    const tell = ([name, , factor], k) => `${plot.names[k]} ${last[COLUMNS[name]] === null ? "–" : (last[COLUMNS[name]] * factor).toFixed(plot.unit ? 1 : 0)}`.trim();
    plot.value.textContent = `${plot.lines.map(tell).join("  ")} ${plot.unit}`;
    context.fillStyle = colours.faint;
    context.font = "10px system-ui, sans-serif";
    context.textAlign = "right";
    context.fillText(`${top % 1 ? top.toFixed(1) : top} ${plot.unit}`, width, 8);
  }

  // A scale robust to a single peak: twice the 98th percentile, at most the maximum.
  top(plot, rows) {
    const values = [];
    for (const [name, , factor] of plot.lines) for (const row of rows) if (row[COLUMNS[name]] !== null) values.push(row[COLUMNS[name]] * factor);
    values.sort((a, b) => a - b);
    const most = values[values.length - 1] || 0, usual = values[Math.floor(0.98 * (values.length - 1))] || 0;
    const wanted = Math.max(plot.least, Math.min(most, 2 * usual)), size = 10 ** Math.floor(Math.log10(wanted));
    return [1, 2, 3, 5, 10].map((k) => k * size).find((value) => value >= wanted * 0.999);
  }

  // The state over time as a line at the bottom.
  states(context, rows, x, height, colours) {
    for (let i = 1; i < rows.length; i++) {
      context.fillStyle = colours[STATES[rows[i][COLUMNS.state]] || "faint"];
      const left = x(rows[i - 1][0]);
      context.fillRect(left, height - 3, Math.max(1, x(rows[i][0]) - left + 0.5), 3);
    }
  }
}
