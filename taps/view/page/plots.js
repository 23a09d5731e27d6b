// Small plots of the last ten minutes, with a time axis and the values at the pointer.

import { STATES } from "./colours.js";
import { clock, element } from "./panel.js";
import { COLUMNS } from "./world.js";

const SPAN_S = 600, LEAST_S = 30, STEPS = [5, 10, 30, 60, 120, 300], TICK_PX = 52, AXIS = 16, HEAD = 6, GUTTER = 42, NEAR_S = 2;
const PLOTS = [
  { title: "", lines: [["sigma", "good", 100, "position σ"], ["bound", "accent", 100, "protection level"]], unit: "cm", least: 5 },
  { title: "cycle time", lines: [["cycle", "accent", 0.001, ""]], unit: "ms", least: 2 },
  { title: "latency of the pose", lines: [["late", "teal", 1000, ""]], unit: "ms", least: 20 },
  { title: "lamps used", lines: [["used", "warn", 1, ""]], unit: "", least: 4 },
];

export class Plots {
  // redraw: asks for a drawing soon.
  constructor(world, into, redraw) {
    this.world = world;
    this.redraw = redraw;
    this.cursor = null;      // the time at the pointer; null: the latest values are shown
    this.first = null;       // begin of a recording; null: live
    this.all = PLOTS.map((plot) => this.made(plot, into));
  }

  made(plot, into) {
    const box = element("figure", "plot"), cap = element("figcaption", "cap"), canvas = element("canvas"), values = [];
    if (plot.title) cap.append(element("span", "title", plot.title));
    for (const [, colour, , name] of plot.lines) {
      const part = element("span", "value"), value = element("b");
      if (plot.lines.length > 1) { const key = element("i"); key.dataset.colour = colour; part.append(key, `${name} `); }
      part.append(value);
      cap.append(part);
      values.push(value);
    }
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "img");
    const point = (event) => this.point((event.clientX - canvas.getBoundingClientRect().left - GUTTER) / (canvas.clientWidth - GUTTER));
    for (const kind of ["pointerdown", "pointermove"]) canvas.addEventListener(kind, point);
    for (const kind of ["pointerleave", "pointercancel", "blur"]) canvas.addEventListener(kind, () => this.point(null));
    canvas.addEventListener("keydown", (event) => this.key(event));
    box.append(cap, canvas);
    into.append(box);
    return { ...plot, box, values, canvas };
  }

  // part: of the width, from 0 to 1; null: none.
  point(part) {
    const span = this.span();
    this.cursor = part === null || !span ? null : span[0] + Math.min(1, Math.max(0, part)) * (span[1] - span[0]);
    this.redraw();
  }

  key(event) {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key], span = this.span();
    if (!step || !span) return;
    event.preventDefault();
    event.stopPropagation();
    this.cursor = Math.min(span[1], Math.max(span[0], (this.cursor ?? span[1]) + step * (span[1] - span[0]) / 60));
    this.redraw();
  }

  // Begin and end of the time axis; null: no values.
  span() {
    const rows = this.world.rows, last = rows[rows.length - 1];
    if (!last) return null;
    if (this.first !== null) return [Math.max(last[0] - SPAN_S, this.first), Math.max(last[0], this.first + LEAST_S)];
    return [Math.max(last[0] - SPAN_S, Math.min(rows[0][0], last[0] - LEAST_S)), last[0]];
  }

  // The row next to the pointer, else the latest; null: none is near.
  row() {
    const rows = this.world.rows;
    if (this.cursor === null) return rows[rows.length - 1];
    let found = null;
    for (const row of rows) if (!found || Math.abs(row[0] - this.cursor) < Math.abs(found[0] - this.cursor)) found = row;
    return found && Math.abs(found[0] - this.cursor) < NEAR_S ? found : null;
  }

  draw(colours, ratio) {
    const rows = this.world.rows, span = this.span();
    if (!span || document.hidden) return;
    const row = this.row();
    for (const plot of this.all) {
      plot.box.hidden = !rows.some((one) => plot.lines.some(([name]) => one[COLUMNS[name]]));
      if (plot.box.hidden) continue;
      this.one(plot, rows, span, colours, ratio);
      this.tell(plot, row);
    }
  }

  tell(plot, row) {
    const texts = plot.lines.map(([name, , factor], k) => {
      const value = row && row[COLUMNS[name]], number = value === null ? "–" : (value * factor).toFixed(plot.unit ? 1 : 0);
      return plot.values[k].textContent = `${number}${plot.unit ? ` ${plot.unit}` : ""}`;
    });
    const names = plot.lines.map(([, , , name], k) => `${name || plot.title} ${texts[k]}`).join(", ");
    plot.canvas.setAttribute("aria-label", this.cursor === null ? names : `${this.when(this.cursor)}: ${names}`);
  }

  // A time as it stands at the axis: of the recording, else before the latest value.
  when(t) {
    if (this.first !== null) return clock(t - this.first);
    const ago = this.span()[1] - t;
    return ago < 0.5 ? "now" : `−${clock(ago)}`;
  }

  one(plot, rows, [begin, end], colours, ratio) {
    const { canvas } = plot, width = canvas.clientWidth, height = canvas.clientHeight, context = canvas.getContext("2d");
    if (!width) return;
    if (canvas.width !== Math.round(width * ratio)) { canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio); }
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const foot = height - AXIS, top = this.top(plot, rows), unit = plot.unit ? ` ${plot.unit}` : "";
    const x = (t) => GUTTER + (t - begin) / Math.max(1, end - begin) * (width - GUTTER), y = (v) => foot - 4 - v / top * (foot - 4 - HEAD);
    context.font = "11px system-ui, sans-serif";
    context.lineWidth = 1;
    this.axis(context, begin, end, x, foot, width, colours);
    this.states(context, rows, x, foot, colours);
    context.strokeStyle = colours.line;
    context.beginPath();
    for (const part of [0, 0.5, 1]) { context.moveTo(GUTTER, y(part * top)); context.lineTo(width, y(part * top)); }
    context.stroke();
    for (const [name, colour, factor] of plot.lines) curve(context, rows, COLUMNS[name], (t, v) => [x(t), y(Math.min(top, v * factor))], begin, colours[colour]);
    context.fillStyle = colours.dim;
    context.textAlign = "right";
    for (const value of plot.unit || top % 2 === 0 ? [top, top / 2] : [top]) context.fillText(`${value % 1 ? value.toFixed(1) : value}${unit}`, GUTTER - 5, y(value) + 4);
    if (this.cursor !== null) this.mark(context, x(this.cursor), foot, width, colours);
  }

  // The line at the pointer, with its time on the axis.
  mark(context, left, foot, width, colours) {
    const text = this.when(this.cursor), half = context.measureText(text).width / 2 + 4;
    const middle = Math.min(width - half, Math.max(half, left));
    context.strokeStyle = colours.ink;
    context.beginPath();
    context.moveTo(left, 0);
    context.lineTo(left, foot);
    context.stroke();
    context.fillStyle = colours.card;
    context.fillRect(middle - half, foot + 1, 2 * half, AXIS - 1);
    context.fillStyle = colours.ink;
    context.textAlign = "center";
    context.fillText(text, middle, foot + 13);
  }

  // The time axis below a plot.
  axis(context, begin, end, x, foot, width, colours) {
    const step = STEPS.find((s) => x(begin + s) - GUTTER >= TICK_PX) || 600, from = this.first === null ? end : this.first;
    context.strokeStyle = colours.line;
    context.fillStyle = colours.dim;
    context.beginPath();
    for (let k = Math.ceil((begin - from) / step); from + k * step <= end + 1e-6; k++) {
      const left = x(from + k * step), text = this.when(from + k * step);
      context.moveTo(left, 0);
      context.lineTo(left, foot);
      const half = context.measureText(text).width / 2;
      context.textAlign = left + half > width ? "right" : left < half ? "left" : "center";
      context.fillText(text, Math.min(width, Math.max(0, left)), foot + 13);
    }
    context.stroke();
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

  // The state over time as a bar on the time axis.
  states(context, rows, x, foot, colours) {
    for (let i = 1; i < rows.length; i++) {
      context.fillStyle = colours[STATES[rows[i][COLUMNS.state]] || "none"];
      const left = x(rows[i - 1][0]);
      context.fillRect(left, foot - 3, Math.max(1, x(rows[i][0]) - left + 0.5), 3);
    }
  }
}

function curve(context, rows, column, at, begin, colour) {
  context.beginPath();
  let torn = true;
  for (const row of rows) {
    const value = row[column];
    if (value === null || row[0] < begin) { torn = true; continue; }
    if (torn) context.moveTo(...at(row[0], value)); else context.lineTo(...at(row[0], value));
    torn = false;
  }
  context.strokeStyle = colour;
  context.lineWidth = 1.5;
  context.stroke();
  context.lineWidth = 1;
}
