// The table of received lamps, and the details of one lamp.

import { $, element, put } from "./panel.js";

const WEAKEST = 1e-10;   // A: lower end of the RSS bar
const NEAR_PX = 22;      // of a tap from a lamp

const signed = (part) => `${part >= 0 ? "+" : "−"}${Math.abs(100 * part).toFixed(1)} %`;
const amperes = (a) => (a >= 1e-6 ? `${(1e6 * a).toFixed(2)} µA` : `${(1e9 * a).toFixed(a < 1e-7 ? 1 : 0)} nA`);
const frequency = (hertz) => (hertz >= 999.5 ? `${(hertz / 1000).toFixed(1)} kHz` : `${Math.round(hertz)} Hz`);
const residual = (link) => (link.residual == null ? "–" : signed(Math.expm1(link.residual)));

export class Lamps {
  constructor(world, camera) {
    this.world = world;
    this.camera = camera;
    this.chosen = null;      // number of the lamp whose details are shown
  }

  // The table of the card.
  table() {
    const lights = this.world.lights, pose = this.world.pose;
    const fitted = lights && lights.links !== undefined && pose && pose.links !== null;
    $("card-lights").hidden = !fitted;
    this.details();
    if (!fitted) return;
    const fix = this.world.scene.fixes[lights.fix] || ["", ""];
    put("fix", `light fix ${fix[0]} · ${lights.used} used`);
    $("fix").title = fix[1];
    this.dimmed(lights.dimmed || []);
    const key = lights.links.map((link) => `${link.code},${link.use},${link.strength.toPrecision(3)},${(link.residual || 0).toFixed(2)}`).join();
    if (this.shown === key) return;
    this.shown = key;
    const strongest = Math.max(WEAKEST * 10, ...lights.links.map((link) => link.strength));
    const rows = lights.links.map((link) => this.row(link, strongest));
    $("links").replaceChildren(...(rows.length ? [heads(), ...rows] : [element("span", "", fix[1] || "no lamp is received")]));
  }

  row(link, strongest) {
    const row = element("button", "link"), use = this.world.scene.uses[link.use] || ["OTHER", ""];
    row.dataset.use = use[0];
    row.title = `code ${link.code}: ${use[1]}`;
    row.disabled = link.lamp_id === null;
    row.addEventListener("click", () => this.choose(link.lamp_id));
    const bar = element("span", "bar"), fill = element("i");
    fill.style.width = `${Math.max(2, 100 * Math.log(Math.max(1, link.strength / WEAKEST)) / Math.log(strongest / WEAKEST))}%`;
    bar.append(fill, element("span", "", use[0].toLowerCase()));
    row.append(element("span", "id", link.lamp_id === null ? `code ${link.code}` : String(link.lamp_id)), bar, element("span", "s", amperes(link.strength)), element("span", "r", residual(link)));
    return row;
  }

  // PWM-dimmed lamps, which carry no code.
  dimmed(lamps) {
    const rows = lamps.map(({ hertz, other_hertz: other, swing }) => [`${frequency(hertz)}${other == null ? "" : ` or ${frequency(other)}`}`, `${Number((1e6 * swing).toPrecision(2))} µA`]);
    const key = JSON.stringify(rows);
    if (this.dimmedShown === key) return;
    this.dimmedShown = key;
    $("dimmed").hidden = !rows.length;
    $("dimmed").replaceChildren(...rows.map(([name, text]) => {
      const row = element("div");
      row.append(element("dt", "", `PWM lamp of ${name}`), element("dd", "", text));
      return row;
    }));
  }

  // The lamp at a point of the screen; null: none there.
  at(left, top) {
    if (!this.world.lampsPlaced) return null;
    let found = null, least = NEAR_PX;
    for (const [lamp, , x, y] of this.world.scene.lamps) {
      const [l, t] = this.camera.screen(x, y), apart = Math.hypot(l - left, t - top);
      if (apart < least) { least = apart; found = lamp; }
    }
    return found;
  }

  choose(lamp) {
    this.chosen = lamp === this.chosen ? null : lamp;
    this.world.chosen = this.chosen;
    this.boxShown = "";
    this.details();
    this.camera.changed();
  }

  details() {
    const surveyed = this.world.scene.lamps.find(([lamp]) => lamp === this.chosen);
    $("lamp").hidden = this.chosen === null || !surveyed;
    if ($("lamp").hidden) return;
    const rows = this.facts(surveyed), key = JSON.stringify(rows);
    if (this.boxShown === key) return;
    this.boxShown = key;
    const list = element("dl", "rows"), close = element("button", "small", "Close");
    for (const [name, text] of rows) {
      const row = element("div");
      row.append(element("dt", "", name), element("dd", "", text));
      list.append(row);
    }
    close.addEventListener("click", () => this.choose(null));
    const head = element("h2", "", `Lamp ${this.chosen}`);
    head.append(close);
    $("lamp").replaceChildren(head, list);
  }

  facts([lamp, code, x, y]) {
    const { world } = this, pose = world.pose && world.pose.pose;
    const link = ((world.lights && world.lights.links) || []).find((one) => one.lamp_id === lamp);
    const rows = [["code", String(code)], ["position", `${x.toFixed(2)}, ${y.toFixed(2)} m`]];
    if (pose) rows.push(["horizontal distance", `${Math.hypot(x - pose[0], y - pose[1]).toFixed(2)} m`]);
    if (!link) return [...rows, ["use", "not received"]];
    const use = world.scene.uses[link.use] || ["OTHER", ""];
    return [...rows, ["use", `${use[0].toLowerCase()}: ${use[1]}`], ["RSS", amperes(link.strength)], ["residual", residual(link)]];
  }
}

function heads() {
  const row = element("div", "link heads");
  const titled = (text, title) => { const made = element("span", "", text); made.title = title; return made; };
  row.append(titled("lamp", "number in the survey"), titled("use", "bar: RSS on a logarithmic scale"), titled("RSS", "received signal strength"), titled("residual", "received against expected RSS"));
  return row;
}
