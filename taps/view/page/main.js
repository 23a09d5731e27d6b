// Connects the parts of the page: messages update the world, and a changed world is drawn.

import { Camera } from "./camera.js";
import { Cycle } from "./cycle.js";
import { Painter } from "./draw.js";
import { Events } from "./events.js";
import { FaultList } from "./faults.js";
import { eventsFile, picture, scaleOf, values } from "./files.js";
import { Lamps } from "./lamps.js";
import { Link } from "./link.js";
import { Orders } from "./orders.js";
import { $, element, Panel, put } from "./panel.js";
import { Plots } from "./plots.js";
import { CAN_INFLATE } from "./tiles.js";
import { TimeBar } from "./timebar.js";
import { Tools } from "./tools.js";
import { World } from "./world.js";

const WORDS_MS = 200, PLOTS_MS = 500, SLOW_MS = 400, TOAST_MS = 4000, OLD_MS = 3000, LATE = 200;
const TOO_OLD = CAN_INFLATE ? "" : "This browser is too old to draw the map. Use one of 2023 or later.";

const world = new World();
const camera = new Camera($("stage"), () => { baseDirty = true; schedule(); });
const painter = new Painter($("base"), $("over"), world, camera);
const panel = new Panel(world);
const faults = new FaultList();
const lamps = new Lamps(world, camera);
const cycle = new Cycle(world);
const events = new Events(world);
const plots = new Plots(world, $("plots"), () => { plotsAt = 0; schedule(); });
let baseDirty = true, scheduled = false, gone = "", wordsAt = 0, plotsAt = 0, session = 0, recording = null, poseAt = 0, old = false;
const late = [];          // latest delays from scan to screen, ms
let unshown = null;       // the pose of the next drawing

const link = new Link({
  welcome(words) {
    world.scene = { ...world.scene, ...words };
    recording = words.recording;
    put("name", recording || words.name);
    orders.welcome(words);
    tools.scene();
    $("token").close();
    if (words.wrong_token) toast("Wrong token. The page is read-only.", "bad");
  },
  refused(words) {
    if (words.what === "token") $("token").showModal();
    else banner(words.what === "version" ? words.text : `${words.text} Trying again.`);
  },
  lost() {
    if (!gone && poseAt) event("Connection to the page's server lost", "bad");
    gone = barred() ? "a token is needed" : "no connection to the page's server; trying again";
    if (!link.refused) banner("No connection to the page's server. Trying again.");
    orders.lost();
    schedule();
  },
  frame,
});
const orders = new Orders(link, camera, toast);
const tools = new Tools(world, camera, lamps);
const timebar = new TimeBar(link, world);

function frame(topic, data) {
  if (topic === "daemon") daemon(data);
  else if (topic === "order") { orders.take(data); event(`Command ${orders.worded(data)}`, "accent"); }
  else if (topic === "film") { timebar.take(data); plots.first = events.first = data.t_first; }
  else if (topic === "scene") { world.scene = { ...world.scene, ...data }; put("name", recording || data.name); tools.scene(); }
  else if (topic === "past") events.on_past(data);
  else if (world.take(topic, data)) {
    if (topic === "rewound") events.forget();
    else if (events[`on_${topic}`]) events[`on_${topic}`](data);
    if (topic === "pose") { unshown = data; gone = ""; poseAt = performance.now(); }
    if (topic === "map") baseDirty = true;
    if (topic === "loop" && !recording) toast(`Loop closure: keyframe ${data.keyframe_new} to ${data.keyframe_old}`, "loop");
  }
  schedule();
}

function daemon(data) {
  if (data.session !== session) { world.forget(); session = data.session; camera.fitted = false; if (!recording) events.state = events.map = events.jumps = null; }
  if (!data.up && !gone && poseAt) event(`No daemon: ${data.why}`, "bad");
  gone = data.up ? "" : data.why;
  banner(data.up ? "" : `No daemon: ${data.why}`);
}

// Something that happens now.
function event(text, colour) { if (!recording) events.add(events.now(link.now()), text, colour); }

// Refused without a token: no reconnect until there is one.
function barred() { return link.refused === "token"; }

function banner(told) {
  const text = told || TOO_OLD;
  $("banner").hidden = !text;
  $("banner").textContent = text;
}

function toast(text, cls = "") {
  const made = element("div", `toast ${cls}`, text);
  $("toasts").append(made);
  while ($("toasts").children.length > 3) ($("toasts").querySelector(".loop") || $("toasts").firstChild).remove();
  setTimeout(() => made.remove(), TOAST_MS);
}

function schedule() {
  if (scheduled) return;
  scheduled = true;
  requestAnimationFrame(draw);
}

function draw(now) {
  scheduled = false;
  const pose = world.pose && world.pose.pose;
  const before = [camera.x, camera.y];
  if (!camera.fitted) fit();
  if (pose) camera.keep(pose[0], pose[1]);
  if (world.tiles.dirty || world.drawn || baseDirty || before[0] !== camera.x || before[1] !== camera.y) {
    baseDirty = world.drawn = false;
    painter.below();
    scale();
  }
  const moving = painter.above(performance.now());
  if (unshown) measure();
  if (now - wordsAt > WORDS_MS) { wordsAt = now; words(); }
  if (now - plotsAt > PLOTS_MS) { plotsAt = now; plots.draw(painter.c, devicePixelRatio); timebar.draw(painter.c); }
  if (moving) schedule();
}

function fit() {
  camera.fit(world.been());
}

// Age of the scan on the screen.
function measure() {
  if (!recording) {
    late.push(1000 * (link.now() - (unshown.t_utc - unshown.t_sent + unshown.t_mono)));
    if (late.length > LATE) late.shift();
  }
  unshown = null;
}

// A connected daemon without messages; unknown while the server is silent, too.
function stale() {
  const now = poseAt > 0 && !recording && !gone && performance.now() - poseAt > OLD_MS;
  const who = link.heard - poseAt > OLD_MS ? ": the daemon does not respond" : "";
  if (now) banner(`No new pose for ${Math.round((performance.now() - poseAt) / 1000)} s${who}`);
  else if (old && !gone) banner("");
  old = now;
}

function words() {
  stale();
  const state = panel.state(gone, barred() ? "NO TOKEN" : link.socket ? "NO DAEMON" : "NO SERVER");
  const title = `${state} – ${$("name").textContent} – lumiloop`;
  if (document.title !== title) document.title = title;
  faults.show(gone ? [] : world.faults);
  panel.pose();
  lamps.table();
  cycle.show();
  events.show();
  const usual = [...late].sort((a, b) => a - b)[late.length >> 1];
  $("late-tag").hidden = Boolean(recording);
  put("late", usual === undefined || gone ? "– ms" : `${Math.round(usual)} ms`);
  $("late-tag").classList.toggle("slow", usual > SLOW_MS);
}

function scale() {
  const { metres, pixels } = scaleOf(camera);
  $("scale-bar").style.width = `${pixels}px`;
  put("scale-text", `${metres} m`);
}

// A file's name, of this robot and this time.
function fileName() { return `lumiloop-${$("name").textContent}-${new Date().toISOString().slice(0, 19).replaceAll(":", "")}`; }

function theme(name) {
  document.documentElement.dataset.theme = name;
  document.querySelector("meta[name=theme-color]").content = name === "light" ? "#f3f5f9" : "#141a23";
  painter.recolour();
  baseDirty = true;
  plotsAt = 0;
  schedule();
}

const wanted = matchMedia("(prefers-color-scheme: light)");
const chosen = () => localStorage.getItem("lumiloop-theme") || (wanted.matches ? "light" : "dark");
wanted.addEventListener("change", () => theme(chosen()));
$("theme").addEventListener("click", () => {
  localStorage.setItem("lumiloop-theme", document.documentElement.dataset.theme === "light" ? "dark" : "light");
  theme(chosen());
});
$("zoom-in").addEventListener("click", () => camera.zoom(1.4));
$("zoom-out").addEventListener("click", () => camera.zoom(1 / 1.4));
$("fit").addEventListener("click", () => { camera.fitted = false; schedule(); });
$("follow").addEventListener("click", () => camera.setFollow(!camera.follow));
$("shot").addEventListener("click", () => picture($("stage"), camera, painter.c, painter.ratio, `${$("name").textContent}   ${$("state-name").textContent}   x ${$("x").textContent}, y ${$("y").textContent} m, ${$("yaw").textContent}   ${new Date().toISOString().slice(0, 19)}Z`, fileName()));
$("csv").addEventListener("click", () => values(world, fileName()));
$("events-csv").addEventListener("click", () => eventsFile(events, fileName()));
$("card-cycle").addEventListener("toggle", () => cycle.show());
camera.onmode = (mode) => { orders.mode(mode); tools.mode(mode); };
camera.onfollow = (on) => $("follow").setAttribute("aria-pressed", String(on));
for (const button of document.querySelectorAll("[data-layer]")) button.addEventListener("click", () => {
  const on = painter.layers[button.dataset.layer] = button.getAttribute("aria-pressed") !== "true";
  button.setAttribute("aria-pressed", String(on));
  schedule();
});
$("token").addEventListener("close", () => {
  const text = $("token-text").value.trim();
  $("token-text").value = "";
  if (text) { banner(""); link.use(text); }
  else if (barred()) banner("This page needs a token. Press here to enter it, or open the address that lumiloop view printed.");
});
$("banner").addEventListener("click", () => { if (barred()) $("token").showModal(); });
new ResizeObserver(() => {
  const box = $("stage").getBoundingClientRect();
  camera.resize(box.width, box.height);
  painter.resize(devicePixelRatio);
  baseDirty = true;
  draw(performance.now());
}).observe($("stage"));
setInterval(schedule, 1000);
theme(chosen());
link.open();

globalThis.lumiloop = { world, camera, link, late, events, plots, painter };   // for debugging and for the tests
