// The card for developers: computing times of a cycle, and figures of the process.

import { $, clock, element, known, ms, put } from "./panel.js";

export class Cycle {
  constructor(world) { this.world = world; }

  show() {
    const pose = this.world.pose, statistics = this.world.statistics;
    if (!pose || !$("card-cycle").open) return;
    const pulse = pose.pulse, scene = this.world.scene;
    const period = (statistics && statistics.scan_period) || (pose.scan_rate ? 1 / pose.scan_rate : 0.1);
    const budget = scene.budget_ms ? 1000 * scene.budget_ms : 5e5 * period;
    put("rung", pulse && pulse.rung ? scene.rungs[pulse.rung] || "" : `cycle budget ${ms(budget)}`);
    $("rung").className = pulse && pulse.rung ? "guess" : "";
    const rows = [["cycle", (pulse && pulse.cycle) || (pose.cycle_us === null ? null : [pose.cycle_us, pose.cycle_us, pose.cycle_us]), "total"]];
    if (pulse && pulse.late) rows.push(["latency", pulse.late, ""]);
    for (const [k, spread] of ((pulse && pulse.stages) || []).entries()) if (spread) rows.push([scene.stages[k] || String(k), spread, ""]);
    this.bars(rows, budget);
    this.figures(pose, statistics);
  }

  bars(rows, budget) {
    const key = JSON.stringify([rows, budget]);
    if (this.barsShown === key) return;
    this.barsShown = key;
    const heads = element("div", "row heads");
    heads.append(element("span", "", "stage"), element("span", "", "share of the budget"), element("span", "", "median / 99 %"));
    $("bars").replaceChildren(heads, ...rows.map((row) => bar(row, budget)));
  }

  figures(pose, statistics) {
    const ok = (name, value) => (value === null || value === undefined ? null : `${name} ${value ? "ok" : "NOT OK"}`);
    const devices = [ok("lidar", pose.lidar_ok), ok("photodiode", pose.adc_ok), ok("odometry", pose.odometry_ok)].filter(Boolean).join(", ");
    const rows = [["devices", devices || "–"], ["scans", `${known(pose.scan_rate, (hz) => `${hz.toFixed(1)} Hz`)}, ${pose.missed} missed`], ["cycles over budget", String(pose.overruns)]];
    if (pose.pulse && pose.pulse.stalls) rows.push(["stalls", String(pose.pulse.stalls)]);
    if (statistics) rows.push(["uptime, memory", `${clock(statistics.uptime)}, ${Math.round(statistics.memory_mb)} MB`]);
    const key = JSON.stringify(rows);
    if (this.figuresShown === key) return;
    this.figuresShown = key;
    $("figures").replaceChildren(...rows.map(([name, text]) => {
      const row = element("div");
      row.append(element("dt", "", name), element("dd", text.includes("NOT OK") ? "alert" : "", text));
      return row;
    }));
  }
}

function bar([name, spread, cls], budget) {
  const row = element("div", `row ${cls}`), track = element("div", "track");
  if (!spread) { row.append(element("span", "", name), track, element("span", "", "–")); return row; }
  const [p50, p99, most] = spread, width = (us) => `${Math.min(100, 100 * us / budget)}%`;
  if (p99 > budget) track.classList.add("over");
  for (const [mark, us] of [["p99", p99], ["p50", p50]]) { const fill = element("i", mark); fill.style.width = width(us); track.append(fill); }
  row.title = `${name}: median ${ms(p50)}, 99 % within ${ms(p99)}, maximum ${ms(most)}; the whole bar is the budget`;
  row.append(element("span", "", name), track, element("span", "", `${(p50 / 1000).toFixed(2)} / ${ms(p99)}`));
  return row;
}
