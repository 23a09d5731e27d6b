// The cards beside the map: texts and numbers. Only changed ones are updated.

const FAULTS = 3;         // most faults shown, the most severe ones
const WEAKEST = 1e-10;   // A: lower end of the RSS bar

const shown = new Map();
export const $ = (id) => document.getElementById(id);

export function put(id, text) {
  if (shown.get(id) === text) return;
  shown.set(id, text);
  $(id).textContent = text;
}

export function element(tag, cls, text) {
  const made = document.createElement(tag);
  if (cls) made.className = cls;
  if (text !== undefined) made.textContent = text;
  return made;
}

// Text with `names` marked as code.
function marked(text) { return (text || "").split("`").map((part, k) => (k % 2 ? element("code", "", part) : part)); }

function worded(id, text) {
  if (shown.get(id) === text) return;
  shown.set(id, text);
  $(id).replaceChildren(...marked(text));
}

const known = (value, text) => (value === null || value === undefined ? "–" : text(value));
const metres = (m) => (m < 0.0995 ? `${(100 * m).toFixed(1)} cm` : `${m.toFixed(2)} m`);
const ms = (us) => `${(us / 1000).toFixed(us < 9950 ? 2 : 1)} ms`;
const degrees = (rad) => 180 / Math.PI * rad;
export const clock = (s) => { const t = Math.max(0, Math.round(s)); const h = Math.floor(t / 3600); return `${h ? `${h}:` : ""}${h ? String(Math.floor(t / 60) % 60).padStart(2, "0") : Math.floor(t / 60)}:${String(t % 60).padStart(2, "0")}`; };

export class Panel {
  constructor(world) {
    this.world = world;
    this.loopsShown = "";
    this.faultsOpen = false;
  }

  state(gone, who) {
    const pose = this.world.pose, chip = $("state");
    const name = gone ? "gone" : pose ? pose.state_name : "none";
    if (chip.dataset.state !== name) chip.dataset.state = name;
    put("state-name", gone ? who : pose ? pose.state_name.replace("_", " ") : "connecting");
    const table = pose && this.world.scene.states[pose.state];
    const meaning = gone || (pose ? pose.reason ? pose.meaning : table ? table[1] : "" : "waiting for the first pose");
    put("why", pose && !gone && pose.reason ? pose.meaning : "");
    worded("meaning", meaning || " ");
    $("meaning").classList.toggle("path", meaning.startsWith("/")); // a path keeps its case
    worded("remedy", gone || !pose ? "" : pose.remedy || "");
    this.faults(gone ? [] : this.world.faults);
  }

  faults(list) {
    const key = JSON.stringify(list);
    if (this.faultsShown === key) return;
    this.faultsShown = key;
    const line = ({ fault, meaning, remedy }) => {
      const item = element("li"), what = element("span", "remedy");
      what.append(...marked(remedy));
      item.append(element("b", "", `${fault} `), ...marked(meaning), what);
      return item;
    };
    const items = list.filter((one) => !one.cause).map((one) => {
      const item = line(one), follow = list.filter(({ cause }) => cause === one.fault);
      if (follow.length) {
        const below = element("ul", "follows");
        below.append(...follow.map((each) => line({ ...each, remedy: "" })));
        item.append(below);
      }
      return item;
    });
    const rest = items.splice(FAULTS), more = element("details");
    if (rest.length) {
      more.open = this.faultsOpen;
      more.addEventListener("toggle", () => { this.faultsOpen = more.open; });
      more.append(element("summary", "", `and ${rest.length} more`), ...rest);
      items.push(more);
    }
    $("faults").replaceChildren(...items);
  }

  pose() {
    const told = this.world.pose;
    if (!told) return;
    const p = told.pose, c = told.covariance, seeking = [5, 6, 7].includes(told.state);
    put("x", known(p, () => p[0].toFixed(3)));
    put("y", known(p, () => p[1].toFixed(3)));
    put("yaw", known(p, () => `${degrees(p[2]).toFixed(1)}°`));
    put("sx", known(c, () => `± ${metres(Math.sqrt(c[0]))}`));
    put("sy", known(c, () => `± ${metres(Math.sqrt(c[2]))}`));
    put("syaw", known(c, () => `± ${degrees(Math.sqrt(c[5])).toFixed(2)}°`));
    const missing = ["x", "y", "heading"].filter((_, k) => !told.known[k]);
    put("axes", !p ? "" : seeking ? "a guess: the place is not known" : missing.length ? `not observed: ${missing.join(", ")}` : "metres, map frame");
    $("axes").className = seeking || missing.length ? "guess" : "";
    const trust = told.trust || {}, rests = ["laser", "light", "wheels"].filter((one) => trust[one]).join(", ");
    const bound = trust.horizontal_m == null ? "none" : `${metres(trust.horizontal_m)}${rests ? ` (${rests})` : ""}`;
    put("bound", trust.alert ? `${bound}, ALERT above ${metres(trust.limit_m)}` : bound);
    $("bound").className = trust.alert ? "alert" : "";
    put("speed", known(told.velocity, (v) => `${Math.hypot(v[0], v[1]).toFixed(2)} m/s, ${Math.round(degrees(v[2])) || 0}°/s`));
    put("map-id", `${told.map_id ? told.map_id.toString(16).padStart(8, "0") : "–"}, ${told.jumps} jump${told.jumps === 1 ? "" : "s"}`);
  }

  lights() {
    const told = this.world.lights, pose = this.world.pose;
    const fitted = told && told.links !== undefined && pose && pose.links !== null;
    $("card-lights").hidden = !fitted;
    if (!fitted) return;
    const fix = this.world.scene.fixes[told.fix] || ["", ""];
    put("fix", `${fix[0]} · ${told.used} used`);
    $("fix").title = fix[1];
    const key = told.links.map((link) => `${link.code},${link.use},${link.strength.toPrecision(3)},${(link.residual || 0).toFixed(2)}`).join();
    if (this.linksShown === key) return;
    this.linksShown = key;
    const strongest = Math.max(WEAKEST * 10, ...told.links.map((link) => link.strength));
    const rows = told.links.map((link) => this.link(link, strongest));
    $("links").replaceChildren(...(rows.length ? rows : [element("span", "", fix[1] || "no lamps in view")]));
  }

  link(link, strongest) {
    const row = element("div", "link"), use = this.world.scene.uses[link.use] || ["OTHER", ""];
    row.dataset.use = use[0];
    row.title = `code ${link.code}: ${use[1]}`;
    const bar = element("div", "bar"), fill = element("i");
    fill.style.width = `${Math.max(2, 100 * Math.log(Math.max(1, link.strength / WEAKEST)) / Math.log(strongest / WEAKEST))}%`;
    bar.append(fill, element("span", "", use[0].toLowerCase()));
    const strength = link.strength >= 1e-6 ? `${(1e6 * link.strength).toFixed(2)} µA` : `${(1e9 * link.strength).toFixed(link.strength < 1e-7 ? 1 : 0)} nA`;
    const residual = link.residual == null ? "–" : `${link.residual >= 0 ? "+" : "−"}${Math.abs(100 * Math.expm1(link.residual)).toFixed(1)} %`;
    row.append(element("span", "id", link.lamp_id === null ? `c${link.code}` : String(link.lamp_id)), bar, element("span", "s", strength), element("span", "r", residual));
    return row;
  }

  cycle() {
    const told = this.world.pose, statistics = this.world.statistics;
    if (!told) return;
    const pulse = told.pulse, scene = this.world.scene;
    const period = (statistics && statistics.scan_period) || (told.scan_rate ? 1 / told.scan_rate : 0.1);
    const budget = scene.budget_ms ? 1000 * scene.budget_ms : 5e5 * period;
    put("rung", pulse && pulse.rung ? scene.rungs[pulse.rung] || "" : `budget ${ms(budget)}`);
    $("rung").className = pulse && pulse.rung ? "guess" : "";
    const rows = [["cycle", (pulse && pulse.cycle) || (told.cycle_us === null ? null : [told.cycle_us, told.cycle_us, told.cycle_us]), "total"]];
    if (pulse && pulse.late) rows.push(["late", pulse.late, ""]);
    for (const [k, spread] of ((pulse && pulse.stages) || []).entries()) if (spread) rows.push([scene.stages[k] || String(k), spread, ""]);
    this.bars(rows, budget);
    this.figures(told, statistics);
  }

  bars(rows, budget) {
    const key = JSON.stringify([rows, budget]);
    if (this.barsShown === key) return;
    this.barsShown = key;
    $("bars").replaceChildren(...rows.map(([name, spread, cls]) => {
      const row = element("div", `row ${cls}`), track = element("div", "track");
      if (!spread) { row.append(element("span", "", name), track, element("span", "", "–")); return row; }
      const [p50, p99, most] = spread, width = (us) => `${Math.min(100, 100 * us / budget)}%`;
      if (p99 > budget) track.classList.add("over");
      for (const [mark, us] of [["p99", p99], ["p50", p50]]) { const fill = element("i", mark); fill.style.width = width(us); track.append(fill); }
      row.title = `${name}: median ${ms(p50)}, 99 of 100 within ${ms(p99)}, most ${ms(most)}; the bar is the budget`;
      row.append(element("span", "", name), track, element("span", "", `${(p50 / 1000).toFixed(2)} / ${ms(p99)}`));
      return row;
    }));
  }

  figures(told, statistics) {
    const ok = (name, value) => (value === null || value === undefined ? null : `${name} ${value ? "ok" : "NOT OK"}`);
    const devices = [ok("lidar", told.lidar_ok), ok("photodiode", told.adc_ok), ok("odometry", told.odometry_ok)].filter(Boolean).join(", ");
    const rows = [["devices", devices || "–"], ["scans", `${known(told.scan_rate, (hz) => `${hz.toFixed(1)} Hz`)}, ${told.missed} missed`], ["over budget", String(told.overruns)]];
    if (told.pulse && told.pulse.stalls) rows.push(["stood still", `${told.pulse.stalls} times`]);
    if (statistics) rows.push(["running for", `${clock(statistics.uptime)}, ${Math.round(statistics.memory_mb)} MB`]);
    const key = JSON.stringify(rows);
    if (this.figuresShown === key) return;
    this.figuresShown = key;
    $("figures").replaceChildren(...rows.map(([name, text]) => {
      const row = element("div");
      row.append(element("dt", "", name), element("dd", text.includes("NOT OK") ? "alert" : "", text));
      return row;
    }));
  }

  loops() {
    const loops = this.world.loops, last = loops[loops.length - 1], pose = this.world.pose;
    put("loop-count", pose ? `${pose.loop_counter ?? (last ? last.counter : 0)} so far` : "");
    const key = `${loops.length},${last ? last.counter : 0}`;
    if (this.loopsShown === key) return;
    this.loopsShown = key;
    const items = loops.slice(-6).reverse().map((loop) => {
      const item = element("li"), why = this.world.scene.loops[loop.reason] || ["", ""];
      item.append(element("b", "", `${loop.keyframe_new} → ${loop.keyframe_old}`), loop.residual === null ? "" : `  ${metres(loop.residual)}`, why[0] ? `  ${why[0].toLowerCase()}` : "");
      item.title = why[1];
      return item;
    });
    $("loops").replaceChildren(...(items.length ? items : [element("li", "", "none yet: the robot has to come back to a place")]));
  }
}
