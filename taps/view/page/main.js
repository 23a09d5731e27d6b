// Connects the parts of the page: messages update the world, and a changed world is drawn.

import { Camera } from "./camera.js";
import { Painter } from "./draw.js";
import { Link } from "./link.js";
import { Orders } from "./orders.js";
import { $, element, Panel, put } from "./panel.js";
import { Plots } from "./plots.js";
import { CAN_INFLATE } from "./tiles.js";
import { TimeBar } from "./timebar.js";
import { World } from "./world.js";

const WORDS_MS = 200, PLOTS_MS = 500, SLOW_MS = 400, TOAST_MS = 4000, OLD_MS = 3000, LATE = 200;
const TOO_OLD = CAN_INFLATE ? "" : "This browser is too old to draw the map; one of 2023 or later does";

const world = new World();
const camera = new Camera($("stage"), () => { baseDirty = true; schedule(); });
const painter = new Painter($("base"), $("over"), world, camera);
const panel = new Panel(world);
const plots = new Plots(world, $("plots"));
let baseDirty = true, scheduled = false, gone = "", wordsAt = 0, plotsAt = 0, session = 0, recording = null, poseAt = 0, old = false;
const late = [];          // latest delays from scan to screen, ms
let unshown = null;       // the pose of the next drawing

const link = new Link({
  welcome(words) {
    world.scene = { ...world.scene, ...words };
    recording = words.recording;
    document.title = `${words.name} – lumiloop`;
    put("name", recording || words.name);
    orders.welcome(words);
    $("token").close();
    if (words.wrong_token) toast("That token is not the right one: read-only", "bad");
  },
  refused(words) {
    if (words.what === "token") $("token").showModal();
    else banner(words.what === "version" ? words.text : `${words.text} Trying again.`);
  },
  lost() {
    gone = barred() ? "not shown without a token" : "the page has lost its server; trying again";
    if (!link.refused) banner("No connection to this page's server; trying again");
    orders.lost();
    schedule();
  },
  frame,
});
const orders = new Orders(link, camera, toast);
const timebar = new TimeBar(link, world);

function frame(topic, data) {
  if (topic === "daemon") daemon(data);
  else if (topic === "order") orders.take(data);
  else if (topic === "film") timebar.take(data);
  else if (topic === "scene") { world.scene = { ...world.scene, ...data }; put("name", recording || data.name); }
  else if (world.take(topic, data)) {
    if (topic === "pose") { unshown = data; gone = ""; poseAt = performance.now(); }
    if (topic === "map") baseDirty = true;
    if (topic === "loop" && !recording) toast(`Loop closed: ${data.keyframe_new} → ${data.keyframe_old}`, "loop");
  }
  schedule();
}

function daemon(data) {
  if (data.session !== session) { world.forget(); session = data.session; camera.fitted = false; }
  gone = data.up ? "" : data.why;
  banner(data.up ? "" : `No daemon: ${data.why}`);
}

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
  const box = world.tiles.extent(), pose = world.pose && world.pose.pose;
  if (!box && !pose) return;
  const around = pose ? [pose[0] - 2, pose[1] - 2, pose[0] + 2, pose[1] + 2] : box;
  const all = box ? [Math.min(box[0], around[0]), Math.min(box[1], around[1]), Math.max(box[2], around[2]), Math.max(box[3], around[3])] : around;
  camera.fit(all);
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
  const who = link.heard - poseAt > OLD_MS ? ": the daemon stands" : "";
  if (now) banner(`No new pose for ${Math.round((performance.now() - poseAt) / 1000)} s${who}`);
  else if (old && !gone) banner("");
  old = now;
}

function words() {
  stale();
  panel.state(gone, barred() ? "NO TOKEN" : link.socket ? "NO DAEMON" : "NO SERVER");
  panel.pose();
  panel.lights();
  panel.cycle();
  panel.loops();
  const usual = [...late].sort((a, b) => a - b)[late.length >> 1];
  put("late", recording ? "recording" : usual === undefined || gone ? "– ms" : `${Math.round(usual)} ms`);
  $("late").classList.toggle("slow", usual > SLOW_MS);
}

function scale() {
  const m = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50].find((value) => value * camera.scale >= 60) || 100;
  $("scale-bar").style.width = `${m * camera.scale}px`;
  put("scale-text", `${m} m`);
}

function theme(name) {
  document.documentElement.dataset.theme = name;
  document.querySelector("meta[name=theme-color]").content = name === "light" ? "#f3f5f9" : "#0d1117";
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
camera.onfollow = (on) => $("follow").setAttribute("aria-pressed", String(on));
for (const button of document.querySelectorAll("[data-layer]")) button.addEventListener("click", () => {
  const on = painter.layers[button.dataset.layer] = button.getAttribute("aria-pressed") !== "true";
  button.setAttribute("aria-pressed", String(on));
  schedule();
});
addEventListener("keydown", (event) => {
  if (event.target.closest("input, select, dialog") || event.ctrlKey || event.metaKey) return;
  const doing = { "+": () => camera.zoom(1.4), "-": () => camera.zoom(1 / 1.4), 0: () => $("fit").click(), f: () => $("follow").click() }[event.key];
  if (doing) doing();
});
$("token").addEventListener("close", () => {
  const text = $("token-text").value.trim();
  $("token-text").value = "";
  if (text) { banner(""); link.use(text); }
  else if (barred()) banner("Not shown without a token. Press here to give it, or open the address that lumiloop view printed.");
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

globalThis.lumiloop = { world, camera, link, late };   // for debugging and for the tests
