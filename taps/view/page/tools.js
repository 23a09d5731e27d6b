// The buttons on the map: legend, ruler, coordinates at the pointer, lamp details; and the keys.

import { legend } from "./colours.js";
import { $, element, put } from "./panel.js";

const WIDE_PX = 1000, PAN_PX = 60, LEGEND = "lumiloop-legend";
const KEYS = [
  ["+ −", "zoom in and out"], ["arrows", "move the map; in a recording 5 s back and forth"], ["0", "show where the robot has been"],
  ["f", "keep the robot in view"], ["l", "legend"], ["r", "ruler: press and drag"], ["s", "save the map as an image"],
  ["c", "save the last ten minutes as CSV"], ["t", "light or dark"], ["space", "in a recording: play or pause"],
  ["Esc", "end ruler, pose or lamp details"], ["?", "this list"],
];

export class Tools {
  constructor(world, camera, lamps) {
    this.world = world;
    this.camera = camera;
    this.lamps = lamps;
    $("keys-list").append(...KEYS.flatMap(([key, text]) => [element("dt", "", key), element("dd", "", text)]));
    $("help").addEventListener("click", () => $("keys").showModal());
    $("legend-open").addEventListener("click", () => this.legend($("legend").hidden, true));
    $("ruler").addEventListener("click", () => camera.setMode(camera.mode === "ruler" ? "move" : "ruler"));
    camera.onhover = (x, y) => this.at(x, y);
    camera.ontap = (left, top) => this.tap(left, top);
    $("stage").addEventListener("pointerleave", () => put("at", ""));
    addEventListener("keydown", (event) => this.key(event));
    const kept = localStorage.getItem(LEGEND);
    this.legend(kept === null ? innerWidth >= WIDE_PX : kept === "open" && innerWidth >= WIDE_PX, false);
  }

  legend(open, chosen) {
    if (open) legend($("legend"), this.world.scene.lamps.length > 0);
    $("legend").hidden = !open;
    $("legend-open").setAttribute("aria-expanded", String(open));
    const width = open ? $("legend").offsetWidth + 74 : 0;
    this.camera.covered = width < this.camera.width / 2 ? width : 0;
    this.camera.changed();
    if (chosen) localStorage.setItem(LEGEND, open ? "open" : "closed");
  }

  // Another scene, perhaps with lamps.
  scene() { this.legend(!$("legend").hidden, false); }

  mode(mode) { $("ruler").setAttribute("aria-pressed", String(mode === "ruler")); }

  at(x, y) { put("at", `x ${x.toFixed(2)}, y ${y.toFixed(2)} m`); }

  tap(left, top) {
    const lamp = this.lamps.at(left, top);
    if (lamp !== null) this.lamps.choose(lamp);
    this.at(...this.camera.world(left, top));
  }

  key(event) {
    if (event.target.closest("input, select, dialog") || event.ctrlKey || event.metaKey || event.altKey) return;
    const press = (id) => () => $(id).click();
    const arrows = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const keys = { "+": press("zoom-in"), "-": press("zoom-out"), 0: press("fit"), f: press("follow"), l: press("legend-open"), r: press("ruler"), s: press("shot"), c: press("csv"), t: press("theme"), "?": press("help"), Escape: () => this.escape() };
    if (arrows[event.key] && $("timebar").hidden && event.target === document.body) {
      event.preventDefault();
      this.camera.pan(...arrows[event.key].map((part) => PAN_PX * part));
    } else if (keys[event.key]) keys[event.key]();
  }

  escape() {
    this.camera.setMode("move");
    if (this.lamps.chosen !== null) this.lamps.choose(null);
  }
}
