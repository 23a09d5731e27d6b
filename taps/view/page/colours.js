// Which colour stands for what, and the legend of the map. The colours themselves are in style.css.

import { element } from "./panel.js";

export const STATES = ["none", "bad", "teal", "good", "warn", "seek", "bad", "seek"];   // by number
export const USES = { ACCEPTED: "good", OCCLUDED: "warn", MISSING: "warn", REJECTED: "bad", TWIN: "bad", UNSURVEYED: "bad" };
const NAMES = ["bg", "ink", "dim", "faint", "accent", "good", "teal", "warn", "seek", "bad", "lamp", "lamp-edge", "grid", "scan", "card", "line"];

const cell = (colour) => `<rect x="5" y="2" width="18" height="12" fill="var(--${colour})" stroke="var(--faint)"/>`;
const line = (colour, more = "") => `<path d="M1 8h26" stroke="var(--${colour})" stroke-width="2.5" fill="none" ${more}/>`;
const robot = (colour) => `<path d="M23 8L7 14l4-6-4-6z" fill="var(--${colour})"/>`;
const lamp = (colour) => `<circle cx="14" cy="8" r="4" fill="var(--lamp)" stroke="var(--lamp-edge)"/>${colour ? `<circle cx="14" cy="8" r="6.5" fill="none" stroke="var(--${colour})" stroke-width="2"/>` : ""}`;
const dashed = 'stroke-dasharray="5 4"';
const LEGEND = [
  ["Map", [
    [cell("free"), "free"], [cell("wall"), "wall or object"], [cell("bg"), "unknown"],
  ]],
  ["State of the robot", [
    [robot("good") + line("good", 'stroke-opacity="0.5"'), "TRACKING; the line is the trajectory"], [robot("teal"), "MAPPING"], [robot("warn"), "DEGRADED"],
    [robot("seek"), "AMBIGUOUS, RELOCATING"], [robot("bad"), "LOST, NO LIDAR"], [robot("faint"), "STARTING"],
    ['<path d="M1 8h9" stroke="var(--teal)" stroke-width="4"/><path d="M10 8h17" stroke="var(--good)" stroke-width="4"/>', "the state over time, in the plots"],
  ]],
  ["Lines", [
    ['<path d="M4 8h.1m6-2h.1m6 3h.1m6-1h.1" stroke="var(--scan)" stroke-width="4" stroke-linecap="square"/>', "latest scan"],
    ['<ellipse cx="14" cy="8" rx="11" ry="5" fill="var(--good)" fill-opacity="0.25" stroke="var(--good)" stroke-width="1.5"/>', "95 % of the covariance"],
    [line("accent", dashed), "protection level"], [line("bad", dashed), "protection level above the alert limit"],
    [line("seek") + '<circle cx="3" cy="8" r="3" fill="var(--seek)"/><circle cx="25" cy="8" r="3" fill="var(--seek)"/>', "loop closure"],
  ]],
  ["Lamps", [
    [lamp(""), "surveyed, not received"], [lamp("ink"), "chosen by a tap"], [lamp("good") + line("good", 'stroke-opacity="0.8"'), "used; a thicker line is a larger RSS"],
    [line("warn", dashed), "occluded or missing"], [line("bad", dashed), "rejected, duplicate code or not surveyed"], [line("faint", dashed), "not used: paused, rim, faint"],
  ]],
];

// The values of all colours in the present theme.
export function colours() {
  const style = getComputedStyle(document.documentElement), found = {};
  for (const name of [...NAMES, "wall", "free"]) found[name] = style.getPropertyValue(`--${name}`).trim();
  found.none = found.faint;
  return found;
}

export function rgb(text) {
  const n = parseInt(text.slice(1, 7), 16);
  return [n >> 16, (n >> 8) & 255, n & 255];
}

export function legend(into, withLamps) {
  into.replaceChildren();
  for (const [title, rows] of LEGEND) {
    if (title === "Lamps" && !withLamps) continue;
    const list = element("ul");
    for (const [drawing, text] of rows) {
      const item = element("li");
      item.append(swatch(drawing), text);
      list.append(item);
    }
    into.append(element("h2", "", title), list);
  }
}

// A drawing of 28 x 16 pixels from the constants above.
function swatch(drawing) {
  const parsed = new DOMParser().parseFromString(`<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 28 16" aria-hidden="true">${drawing}</svg>`, "image/svg+xml");
  return document.importNode(parsed.documentElement, true);
}
