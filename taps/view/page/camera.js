// The view of the map: metres to pixels, and its control by mouse, touch and keys.

const NEAREST = 600, FARTHEST = 2, INNER = 0.32, TAP_PX = 6;

export class Camera {
  constructor(stage, changed) {
    this.stage = stage;
    this.changed = changed;
    this.x = this.y = 0;
    this.scale = 48;         // pixels a metre
    this.follow = true;
    this.fitted = false;     // the user has not chosen a view yet
    this.shown = "";         // what the view was last fitted to
    this.width = this.height = 1;
    this.covered = 0;        // pixels on the right that the legend covers
    this.fingers = new Map();
    this.mode = "move";      // what dragging does: "move" the map, give a "pose", or measure with the "ruler"
    this.aim = null;         // {from, to}: the pose or the distance that is being dragged, m
    this.pressed = null;     // where a finger went down that has not moved; null: it has
    this.listen();
  }

  screen(x, y) { return [this.width / 2 + (x - this.x) * this.scale, this.height / 2 - (y - this.y) * this.scale]; }
  world(left, top) { return [this.x + (left - this.width / 2) / this.scale, this.y - (top - this.height / 2) / this.scale]; }
  seen() { const [x0, y0] = this.world(0, this.height), [x1, y1] = this.world(this.width, 0); return [x0, y0, x1, y1]; }

  resize(width, height) {
    this.width = width;
    this.height = height;
    this.changed();
  }

  zoom(factor, left = this.width / 2, top = this.height / 2) {
    const [x, y] = this.world(left, top);
    this.scale = Math.min(NEAREST, Math.max(FARTHEST, this.scale * factor));
    const [nx, ny] = this.world(left, top);
    this.x += x - nx;
    this.y += y - ny;
    this.fitted = true;
    this.shown = "";
    this.changed();
  }

  fit(box) {
    if (!box) return;
    const [x0, y0, x1, y1] = box, key = [...box, this.width, this.height, this.covered].join();
    this.x = (x0 + x1) / 2;
    this.y = (y0 + y1) / 2;
    this.scale = Math.min(160, Math.max(FARTHEST, Math.min((this.width - this.covered) / (x1 - x0 + 1), (this.height - 60) / (y1 - y0 + 1))));
    this.x += this.covered / 2 / this.scale;
    if (key !== this.shown) this.changed();   // else every drawing would ask for the next one
    this.shown = key;
  }

  // Move the map by pixels.
  pan(right, down) {
    this.x -= right / this.scale;
    this.y += down / this.scale;
    this.fitted = true;
    this.shown = "";
    this.setFollow(false);
    this.changed();
  }

  // Keep a point in the inner part of the view.
  keep(x, y) {
    if (!this.follow || this.fingers.size) return;
    const [left, top] = this.screen(x, y), w = INNER * (this.width - this.covered), h = INNER * this.height;
    const dx = left - (this.width - this.covered) / 2, dy = top - this.height / 2;
    const out = (d, limit) => Math.sign(d) * Math.max(0, Math.abs(d) - limit);
    this.x += out(dx, w) / this.scale;
    this.y -= out(dy, h) / this.scale;
  }

  listen() {
    const stage = this.stage;
    stage.addEventListener("pointerdown", (event) => {
      if (event.target.closest("button, .ask, .banner, .legend, .lamp-box")) return;
      stage.setPointerCapture(event.pointerId);
      this.fingers.set(event.pointerId, this.place(event));
      this.pressed = this.fingers.size === 1 ? this.place(event) : null;
      if (this.mode !== "move" && this.fingers.size === 1) {
        const at = this.world(...this.place(event));
        this.aim = { from: at, to: at };
        this.changed();
      }
    });
    stage.addEventListener("pointermove", (event) => {
      this.onhover(...this.world(...this.place(event)));
      if (!this.fingers.has(event.pointerId)) return;
      const before = this.fingers.get(event.pointerId), now = this.place(event);
      if (this.pressed && Math.hypot(now[0] - this.pressed[0], now[1] - this.pressed[1]) > TAP_PX) this.pressed = null;
      if (this.mode !== "move") {
        if (this.aim) this.aim.to = this.world(...now);
      } else if (this.fingers.size === 1) {
        if (!this.pressed) this.pan(now[0] - before[0], now[1] - before[1]);
        else return;
      } else this.pinch(event.pointerId, before, now);
      this.fingers.set(event.pointerId, now);
      this.changed();
    });
    for (const kind of ["pointerup", "pointercancel"]) stage.addEventListener(kind, (event) => {
      if (!this.fingers.delete(event.pointerId)) return;
      if (kind !== "pointerup") return;
      if (this.mode === "pose" && this.aim) this.onaimed(this.aim);
      else if (this.mode === "move" && this.pressed) this.ontap(...this.pressed);
    });
    stage.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0016)), ...this.place(event));
    }, { passive: false });
    stage.addEventListener("dblclick", (event) => {
      if (!event.target.closest("button")) this.zoom(1.8, ...this.place(event));
    });
  }

  pinch(id, before, now) {
    const other = [...this.fingers].find(([key]) => key !== id)[1];
    const apart = (a) => Math.hypot(a[0] - other[0], a[1] - other[1]);
    this.zoom(apart(now) / Math.max(1, apart(before)), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
  }

  place(event) {
    const box = this.stage.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  setFollow(on) {
    if (this.follow === on) return;
    this.follow = on;
    this.onfollow(on);
    this.changed();
  }

  setMode(mode) {
    this.mode = mode;
    this.aim = null;
    this.stage.classList.toggle("aim", mode !== "move");
    this.onmode(mode);
    this.changed();
  }

  onfollow() {}
  onaimed() {}
  onmode() {}
  ontap() {}
  onhover() {}
}
