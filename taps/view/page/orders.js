// Command buttons, the dragged pose, and the outcomes of commands.

import { $, element } from "./panel.js";

const KEPT = 4;
const QUESTIONS = {     // commands that need a confirmation
  relocalise: "The robot gives up its pose and searches for it in the whole map. The pose is not valid until it is found. Stop the robot first.",
  pause: "Mapping stops, and the lidar no longer corrects the pose. Light and odometry continue. The state becomes DEGRADED until you resume.",
};
const SAID = { relocalise: "Relocalise", set_pose: "Set pose", save_map: "Save map", dump_recorder: "Dump recorder", pause: "Pause", resume: "Resume" };

export class Orders {
  constructor(link, camera, toast) {
    this.link = link;
    this.camera = camera;
    this.toast = toast;
    this.told = [];
    this.sent = [];          // commands without a reply yet
    for (const button of document.querySelectorAll("[data-order]")) button.addEventListener("click", () => this.press(button.dataset.order));
    $("ask-yes").addEventListener("click", () => this.send("set_pose", this.pose));
    $("ask-no").addEventListener("click", () => this.aim(false));
    camera.onaimed = (aim) => this.aimed(aim);
    $("confirm").addEventListener("close", () => { if ($("confirm").returnValue === "yes") this.send(this.asked); });
  }

  welcome(words) {
    this.you = words.you;
    const may = Object.keys(words.orders);
    $("card-orders").hidden = !may.length;
    for (const button of document.querySelectorAll("[data-order]")) {
      button.hidden = !may.includes(button.dataset.order);
      button.title = (words.orders[button.dataset.order] || "").replaceAll("`", "");
    }
    $("mode").hidden = Boolean(words.recording);
    $("mode").textContent = may.length ? "control" : "read-only";
    $("mode").classList.toggle("write", may.length > 0);
    $("write-note").textContent = may.length ? `you are viewer ${this.you}` : "";
  }

  press(name) {
    if (name === "set_pose") this.aim(this.camera.mode !== "pose");
    else if (QUESTIONS[name]) this.question(name);
    else this.send(name);
  }

  question(name) {
    this.asked = name;
    $("confirm-title").textContent = `${SAID[name]}?`;
    $("confirm-text").textContent = QUESTIONS[name];
    $("confirm-yes").textContent = SAID[name];
    $("confirm").returnValue = "";
    $("confirm").showModal();
  }

  send(name, pose) {
    if (this.link.say({ order: name, pose })) this.sent.push(name);
    else this.take({ order: name, viewer: this.you, outcome: "not sent, no connection" });
    if (this.camera.mode === "pose") this.aim(false);
  }

  lost() {
    const unknown = this.sent.splice(0);
    for (const order of unknown) this.take({ order, viewer: this.you, outcome: "connection lost, result unknown" });
  }

  // Switch dragging between a pose and the map.
  aim(on) {
    this.camera.setMode(on ? "pose" : "move");
    if (on) $("stage").scrollIntoView({ block: "center" });
  }

  // The camera has another mode, also by a key.
  mode(mode) {
    const on = mode === "pose";
    $("ask").hidden = !on;
    $("ask-yes").hidden = true;
    $("ask-text").textContent = "Press at the robot's position, drag to its heading";
    document.querySelector("[data-order=set_pose]").classList.toggle("on", on);
  }

  aimed({ from, to }) {
    const yaw = Math.atan2(to[1] - from[1], to[0] - from[0]);
    this.pose = [from[0], from[1], yaw];
    $("ask-text").textContent = `${from[0].toFixed(2)}, ${from[1].toFixed(2)} m, ${(180 / Math.PI * yaw).toFixed(0)}°`;
    $("ask-yes").hidden = false;
  }

  take(order) {
    if (order.viewer === this.you) this.sent = this.sent.filter((name) => name !== order.order);
    const key = order.number === undefined ? null : `${order.number},${order.viewer}`;
    const known = key && this.told.find((one) => one.key === key);
    if (known) Object.assign(known, order);
    else this.told.unshift({ ...order, key });
    this.told.length = Math.min(this.told.length, KEPT);
    const ended = order.outcome !== "running";
    const who = order.viewer === this.you ? "" : ` by viewer ${order.viewer}`;
    if (ended || who) this.toast(this.worded(order), order.outcome === "done" ? "good" : order.outcome === "running" ? "" : "bad");
    this.show();
  }

  // A command and its outcome in words.
  worded(order) { return `${SAID[order.order] || order.order}${order.viewer === this.you ? "" : ` by viewer ${order.viewer}`}: ${said(order)}`; }

  show() {
    $("told").replaceChildren(...this.told.map((order) => {
      const item = element("li"), words = ["done", "refused", "running", "replaced"];
      item.append(element("b", "", SAID[order.order] || order.order), order.viewer === this.you ? " (you): " : ` (viewer ${order.viewer}): `, element("span", words.includes(order.outcome) ? order.outcome : "refused", said(order)));
      return item;
    }));
  }
}

function said(order) {
  if (order.outcome === "replaced") return order.by ? `replaced by viewer ${order.by}` : "replaced by another client";
  if (order.outcome === "refused") return "refused; see the daemon's log";
  return order.outcome;
}
