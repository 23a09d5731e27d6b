// What the user can save: the map as a picture, the values of the plots and the events as CSV.

import { COLUMNS } from "./world.js";

const HEADS = {
  t: "t_mono_s", x: "x_m", y: "y_m", yaw: "heading_rad", sigma: "sigma_m", bound: "protection_level_m", cycle: "cycle_us",
  late: "latency_s", used: "lamps_used", state: "state", jumps: "jumps", map: "map_id",
};

export function picture(stage, camera, colours, ratio, words, name) {
  const [base, over] = stage.querySelectorAll("canvas"), canvas = document.createElement("canvas");
  const foot = Math.round(34 * ratio), context = canvas.getContext("2d");
  canvas.width = base.width;
  canvas.height = base.height + foot;
  context.drawImage(base, 0, 0);
  context.drawImage(over, 0, 0);
  context.fillStyle = colours.card;
  context.fillRect(0, base.height, canvas.width, foot);
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.fillStyle = context.strokeStyle = colours.ink;
  context.font = "13px system-ui, sans-serif";
  context.textBaseline = "middle";
  const middle = base.height / ratio + 17, { metres, pixels } = scaleOf(camera);
  context.lineWidth = 2;
  context.strokeRect(14, middle + 2, pixels, 0);
  context.fillText(`${metres} m`, pixels + 22, middle);
  context.textAlign = "right";
  context.fillText(words, camera.width - 14, middle, camera.width - pixels - 90);
  canvas.toBlob((blob) => save(blob, `${name}.png`));
}

// The length of the scale bar.
export function scaleOf(camera) {
  const metres = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50].find((value) => value * camera.scale >= 60) || 100;
  return { metres, pixels: metres * camera.scale };
}

export function values(world, name) {
  const pose = world.pose, offset = pose ? pose.t_utc - pose.t_sent : 0;
  const lines = [`time_utc,${Object.keys(COLUMNS).map((key) => HEADS[key]).join(",")}`];
  for (const row of world.rows) {
    const cells = row.map((value, k) => (value === null ? "" : k === COLUMNS.state ? world.stateName(value) : String(value)));
    lines.push(`${new Date(1000 * (offset + row[COLUMNS.t])).toISOString()},${cells.join(",")}`);
  }
  save(new Blob([lines.join("\n"), "\n"], { type: "text/csv" }), `${name}.csv`);
}

export function eventsFile(events, name) {
  const pose = events.world.pose, offset = pose ? pose.t_utc - pose.t_sent : 0;
  const lines = events.all.map(({ t, text }) => `${new Date(1000 * (offset + t)).toISOString()},${t},"${text.replaceAll('"', '""')}"`);
  save(new Blob([["time_utc,t_mono_s,event", ...lines].join("\n"), "\n"], { type: "text/csv" }), `${name}-events.csv`);
}

function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name.replace(/[^\w.-]+/g, "-");
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}
