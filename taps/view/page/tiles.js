// The map: tiles of log-odds as small images in the colours of the theme.

const SEEN = 12, CLEAR = 8;   // log-odds, in units of the stream's 0.1, at which a cell has its full colour
const FAINTEST = 0.92;        // share of the colour of a cell that is hardly free: it differs from an unknown one

export const CAN_INFLATE = "DecompressionStream" in globalThis;   // Chrome 80, Firefox 113, Safari 16.4

export class Tiles {
  constructor(changed) {
    this.all = new Map();
    this.changed = changed;
    this.size = 6.4;          // of a tile, m
    this.number = 0;
  }

  clear() {
    this.all.clear();
    this.number++;
    this.changed();
  }

  async take(told) {
    this.size = told.side * told.resolution;
    for (const [column, row, packed] of told.tiles) this.put(column, row, packed, told.side);
  }

  async put(column, row, packed, side) {
    const key = `${column},${row}`, number = ++this.number;
    const tile = this.all.get(key) || { column, row, number: 0, cells: null };
    if (tile.number > number) return;
    tile.number = number;
    this.all.set(key, tile);
    const cells = packed.length && CAN_INFLATE ? await inflated(packed) : null;
    if (tile.number !== number || this.all.get(key) !== tile) return;
    tile.cells = cells && cells.some((cell) => cell !== 0) ? cells : null;
    tile.side = side;
    tile.picture = null;
    this.changed();
  }

  repaint() {
    for (const tile of this.all.values()) tile.picture = null;
    this.changed();
  }

  draw(context, camera, colours) {
    context.imageSmoothingEnabled = camera.scale < 1 / (this.size / 128);
    const [x0, y0, x1, y1] = camera.seen();
    for (const tile of this.all.values()) {
      const x = tile.column * this.size, y = tile.row * this.size;
      if (!tile.cells || x > x1 || y > y1 || x + this.size < x0 || y + this.size < y0) continue;
      if (!tile.picture) tile.picture = painted(tile, colours);
      const [left, top] = camera.screen(x, y + this.size), [right, bottom] = camera.screen(x + this.size, y);
      const l = Math.round(left), t = Math.round(top);
      context.drawImage(tile.picture, l, t, Math.round(right) - l, Math.round(bottom) - t);
    }
  }
}

async function inflated(packed) {
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Int8Array(await new Response(stream).arrayBuffer());
}

function painted(tile, colours) {
  const { cells, side } = tile;
  const picture = document.createElement("canvas");
  picture.width = picture.height = side;
  const context = picture.getContext("2d"), image = context.createImageData(side, side);
  const pixels = new Uint32Array(image.data.buffer), shades = shadesOf(colours);
  for (let row = 0, at = 0; row < side; row++) {
    let to = (side - 1 - row) * side;
    for (let column = 0; column < side; column++) pixels[to++] = shades[cells[at++] + 128];
  }
  context.putImageData(image, 0, 0);
  return picture;
}

function shadesOf({ wall, free }) {
  const shades = new Uint32Array(256);
  for (let value = -128; value < 128; value++) {
    const [r, g, b] = value > 0 ? wall : free;
    const alpha = value > 0 ? Math.min(1, value / SEEN) : value < 0 ? Math.min(1, FAINTEST - value / CLEAR * (1 - FAINTEST)) : 0;
    shades[value + 128] = ((Math.round(255 * alpha) << 24) | (b << 16) | (g << 8) | r) >>> 0;
  }
  return shades;
}
