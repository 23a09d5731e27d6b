// The cards of state and pose, and what all cards use: texts and numbers. Only changed ones are updated.

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
export function marked(text) { return (text || "").split("`").map((part, k) => (k % 2 ? element("code", "", part) : part)); }

function worded(id, text) {
  if (shown.get(id) === text) return;
  shown.set(id, text);
  $(id).replaceChildren(...marked(text));
}

export const known = (value, text) => (value === null || value === undefined ? "–" : text(value));
export const metres = (m) => (m < 0.0995 ? `${(100 * m).toFixed(1)} cm` : `${m.toFixed(2)} m`);
export const ms = (us) => `${(us / 1000).toFixed(us < 9950 ? 2 : 1)} ms`;
export const degrees = (rad) => 180 / Math.PI * rad;
export const clock = (s) => { const t = Math.max(0, Math.round(s)); const h = Math.floor(t / 3600); return `${h ? `${h}:` : ""}${h ? String(Math.floor(t / 60) % 60).padStart(2, "0") : Math.floor(t / 60)}:${String(t % 60).padStart(2, "0")}`; };

export class Panel {
  constructor(world) { this.world = world; }

  // gone: why there is no data, empty: there is; who: the word for it. Returns the word shown for the state.
  state(gone, who) {
    const pose = this.world.pose, chip = $("state");
    const name = gone ? "gone" : pose ? pose.state_name : "none";
    if (chip.dataset.state !== name) chip.dataset.state = name;
    const word = gone ? who : pose ? pose.state_name.replace("_", " ") : "connecting";
    put("state-name", word);
    const table = pose && this.world.scene.states[pose.state];
    const meaning = gone || (pose ? pose.reason ? pose.meaning : table ? table[1] : "" : "waiting for the first pose");
    put("why", pose && !gone && pose.reason ? pose.meaning : "");
    worded("meaning", meaning || " ");
    $("meaning").classList.toggle("path", meaning.startsWith("/")); // a path keeps its case
    worded("remedy", gone || !pose ? "" : pose.remedy || "");
    return word;
  }

  pose() {
    const told = this.world.pose;
    if (!told) return;
    const p = told.pose, c = told.covariance, seeking = [5, 6, 7].includes(told.state);
    put("x", known(p, () => p[0].toFixed(3)));
    put("y", known(p, () => p[1].toFixed(3)));
    put("yaw", known(p, () => `${degrees(p[2]).toFixed(1)}°`));
    put("sx", known(c, () => `σ ${metres(Math.sqrt(c[0]))}`));
    put("sy", known(c, () => `σ ${metres(Math.sqrt(c[2]))}`));
    put("syaw", known(c, () => `σ ${degrees(Math.sqrt(c[5])).toFixed(2)}°`));
    const missing = ["x", "y", "heading"].filter((_, k) => !told.known[k]);
    put("axes", !p ? "" : seeking ? "not confirmed" : missing.length ? `not known: ${missing.join(", ")}` : "map frame");
    $("axes").className = seeking || missing.length ? "guess" : "";
    const trust = told.trust || {}, from = { laser: "lidar", light: "light", wheels: "odometry" };
    const rests = Object.keys(from).filter((one) => trust[one]).map((one) => from[one]).join(", ");
    const bound = trust.horizontal_m == null ? "not available" : `${metres(trust.horizontal_m)}${rests ? ` (${rests})` : ""}`;
    put("bound", trust.alert ? `${bound}, ALERT: limit ${metres(trust.limit_m)}` : bound);
    $("bound").className = trust.alert ? "alert" : "";
    put("speed", known(told.velocity, (v) => `${Math.hypot(v[0], v[1]).toFixed(2)} m/s, ${Math.round(degrees(v[2])) || 0}°/s`));
    put("map-id", `${told.map_id ? told.map_id.toString(16).padStart(8, "0") : "–"}, ${told.jumps} jump${told.jumps === 1 ? "" : "s"}`);
  }
}
