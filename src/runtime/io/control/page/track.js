// The track over the shaded relief of the seabed, with the swath, the targets and the ship.
import { byId, degrees, digits, followPointer, ink, painter, say, stepOf } from "./lib.js";
import { saveData, savePicture } from "./save.js";

const CELLS = 128;
const MOST_TILES = 200;
/** Light from the north-west, half way up. */
const LIGHT = [0.5, -0.5, 0.7071];

export class Track {
  constructor(link) {
    this.canvas = byId("track");
    this.link = link;
    this.perPixel = 1.5; // metres to a CSS pixel
    this.paint = painter(this.canvas, (g, w, h, scale) => this.#draw(g, w, h, scale));
    this.clear();
    byId("track-in").addEventListener("click", () => this.zoom(1 / 1.5));
    byId("track-out").addEventListener("click", () => this.zoom(1.5));
    this.canvas.addEventListener("keydown", (e) => {
      if (e.key === "+" || e.key === "-") this.zoom(e.key === "+" ? 1 / 1.5 : 1.5);
    });
    this.canvas.addEventListener("wheel", (e) => {
      e.preventDefault();
      this.zoom(e.deltaY > 0 ? 1.25 : 0.8);
    }, { passive: false });
    followPointer(this, () => this.#read());
  }

  /** Another run: the world may be another. */
  clear() {
    this.lines = [];
    this.tiles = new Map();
    this.world = null;
    this.depths = null;
    this.steep = null;
    this.paint();
  }

  /** Another sonar on the same ship. */
  restart() {
    this.lines = [];
    this.paint();
  }

  zoom(by) {
    this.perPixel = Math.max(0.1, Math.min(200, this.perPixel * by));
    this.paint();
  }

  set(world) {
    this.world = world;
    this.paint();
  }

  add(frame) {
    this.lines.push({ nav: frame.nav, range: frame.range_m, ping: frame.ping, t_ms: frame.t_ms });
    if (this.lines.length > 6000) this.lines.splice(0, 1000);
    // Asked again while the daemon does not know yet.
    if (!this.world) this.link.send({ world: {} });
    this.paint();
    this.#read();
  }

  relief(frame) {
    const key = `${frame.level} ${frame.row} ${frame.col}`;
    this.tiles.set(key, { picture: null, frame });
    if (this.tiles.size > MOST_TILES) this.tiles.delete(this.tiles.keys().next().value);
    let low = Infinity, high = -Infinity;
    for (const tile of this.tiles.values()) {
      if (!tile.frame) continue;
      tile.span ??= spanOf(tile.frame.floats);
      if (tile.span) [low, high] = [Math.min(low, tile.span[0]), Math.max(high, tile.span[1])];
    }
    // A gentle ground is shown steeper than it is, and a steep one as it is.
    this.steep ??= steepness(frame);
    // A tint for the depths that are in sight, drawn anew when these change by much.
    if (!this.depths || low < this.depths[0] || high > this.depths[1]) {
      const room = 0.15 * Math.max(1, high - low);
      this.depths = [low - room, high + room];
      for (const tile of this.tiles.values()) tile.picture = null;
    }
    this.paint();
  }

  #draw(g, w, h, scale) {
    g.fillStyle = ink("well");
    g.fillRect(0, 0, w, h);
    const last = this.lines.at(-1);
    if (!last) return;
    const metres = this.perPixel / scale;
    const middle = [last.nav.east, last.nav.north];
    this.view = { metres, middle, w, h };
    const X = (east) => w / 2 + (east - middle[0]) / metres;
    const Y = (north) => h / 2 - (north - middle[1]) / metres;
    if (this.world?.relief) this.#ground(g, w, h, metres, X, Y);
    this.#swath(g, X, Y);
    g.lineWidth = 1.6 * scale;
    g.strokeStyle = "#fff";
    g.beginPath();
    this.lines.forEach((l, k) => (k === 0 ? g.moveTo(X(l.nav.east), Y(l.nav.north)) : g.lineTo(X(l.nav.east), Y(l.nav.north))));
    g.stroke();
    g.font = `${10.5 * scale}px system-ui, sans-serif`;
    g.textBaseline = "middle";
    g.textAlign = "left";
    g.lineWidth = 1.5 * scale;
    for (const [name, north, east] of this.world?.targets ?? []) {
      const x = X(east), y = Y(north), r = 4 * scale;
      if (x < -50 || y < -50 || x > w + 50 || y > h + 50) continue;
      g.strokeStyle = ink("truth");
      g.strokeRect(x - r / 2, y - r / 2, r, r);
      if (metres * scale < 3) {
        g.lineWidth = 3 * scale;
        g.strokeStyle = "#000a";
        g.strokeText(name, x + r + 2 * scale, y);
        g.lineWidth = 1.5 * scale;
        g.fillStyle = "#fff";
        g.fillText(name, x + r + 2 * scale, y);
      }
    }
    drawShip(g, X(last.nav.east), Y(last.nav.north), last.nav.heading, scale);
    drawScaleBar(g, h, metres, scale);
  }

  get isEmpty() {
    return this.lines.length === 0;
  }

  savePicture(name, title) {
    savePicture(`${name}.png`, title, this.canvas, [this.canvas]);
  }

  saveData(name, title) {
    const rows = this.lines.map(({ nav, ping, t_ms }) => [ping, new Date(t_ms).toISOString(), nav.lat.toFixed(7), nav.lon.toFixed(7), nav.north.toFixed(3), nav.east.toFixed(3), nav.down.toFixed(3), nav.heading.toFixed(2), nav.pitch.toFixed(3), nav.roll.toFixed(3), nav.heave.toFixed(3), nav.speed.toFixed(3)]);
    saveData(`${name}.csv`, [title], ["ping", "utc", "latitude_deg", "longitude_deg", "north_m", "east_m", "down_m", "heading_deg", "pitch_deg", "roll_deg", "heave_m", "speed_m_per_s"], rows);
  }

  #ground(g, w, h, metres, X, Y) {
    // About a cell to a pixel, and no more tiles than fit a few times over.
    const level = Math.max(0, Math.min(11, Math.ceil(Math.log2(Math.max(1, metres * 1.5)))));
    const side = CELLS * 2 ** level;
    const [col0, col1] = [Math.floor((this.view.middle[0] - (w / 2) * metres) / side), Math.floor((this.view.middle[0] + (w / 2) * metres) / side)];
    const [row0, row1] = [Math.floor((this.view.middle[1] - (h / 2) * metres) / side), Math.floor((this.view.middle[1] + (h / 2) * metres) / side)];
    for (let row = row0; row <= row1; row++) {
      for (let col = col0; col <= col1; col++) {
        const key = `${level} ${row} ${col}`;
        const tile = this.tiles.get(key);
        if (!tile) {
          this.tiles.set(key, {});
          this.link.send({ relief: { level, row, col } });
        } else if (tile.frame && this.depths) {
          tile.picture ??= shade(tile.frame, this.depths, this.steep ?? 1);
          const x = Math.floor(X(col * side)), y = Math.floor(Y((row + 1) * side));
          g.drawImage(tile.picture, x, y, Math.ceil(X((col + 1) * side)) - x, Math.ceil(Y(row * side)) - y);
        }
      }
    }
  }

  #swath(g, X, Y) {
    g.strokeStyle = "#ffffff66";
    g.fillStyle = "#ffffff12";
    g.lineWidth = 1;
    const edge = (l, sign) => {
      const depth = l.nav.bottom === null ? 0 : Math.max(0, l.nav.bottom - l.nav.down);
      const across = Math.sqrt(Math.max(0, l.range * l.range - depth * depth));
      const bearing = ((l.nav.heading + sign * 90) * Math.PI) / 180;
      return [X(l.nav.east + across * Math.sin(bearing)), Y(l.nav.north + across * Math.cos(bearing))];
    };
    const step = Math.max(1, Math.floor(this.lines.length / 800));
    const some = this.lines.filter((_, k) => k % step === 0);
    g.beginPath();
    some.forEach((l, k) => g[k === 0 ? "moveTo" : "lineTo"](...edge(l, -1)));
    some.toReversed().forEach((l) => g.lineTo(...edge(l, 1)));
    g.closePath();
    g.fill();
    g.stroke();
  }

  #read() {
    const last = this.lines.at(-1);
    if (!last) return;
    const { nav } = last;
    const parts = [`${degrees(nav.lat, "N", "S")} ${degrees(nav.lon, "E", "W")}`, `${digits(nav.heading, 1)}°`, `${digits(nav.speed, 1)} m/s`];
    if (nav.bottom !== null) parts.push(`bottom ${digits(nav.bottom - nav.down, 1)} m below`);
    if (this.at && this.view) {
      const east = this.view.middle[0] + (this.at[0] - this.view.w / 2) * this.view.metres;
      const north = this.view.middle[1] - (this.at[1] - this.view.h / 2) * this.view.metres;
      parts.push(`pointer ${digits(Math.hypot(east - nav.east, north - nav.north), 0)} m off, depth ${digits(this.#depthAt(north, east), 1)} m`);
    }
    say(byId("track-cursor"), parts.join("   "));
  }

  #depthAt(north, east) {
    for (const { frame: f } of this.tiles.values()) {
      if (!f) continue;
      const row = Math.floor(north / f.cell_m - f.row * CELLS), col = Math.floor(east / f.cell_m - f.col * CELLS);
      if (row >= 0 && row < CELLS && col >= 0 && col < CELLS) return f.floats[(row + 1) * (CELLS + 2) + col + 1];
    }
    return NaN;
  }
}

export function drawShip(g, x, y, heading, scale) {
  g.save();
  g.translate(x, y);
  g.rotate((heading * Math.PI) / 180);
  g.beginPath();
  const s = 6 * scale;
  g.moveTo(0, -1.8 * s);
  g.quadraticCurveTo(s, -0.6 * s, 0.8 * s, s);
  g.lineTo(-0.8 * s, s);
  g.quadraticCurveTo(-s, -0.6 * s, 0, -1.8 * s);
  g.fillStyle = "#f3b04a";
  g.strokeStyle = "#1b1206";
  g.lineWidth = 1.2 * scale;
  g.fill();
  g.stroke();
  g.restore();
}

/** A scale bar and the direction of north, for `metres` a pixel. */
export function drawScaleBar(g, h, metres, scale, colour = "#fff", halo = "#000a") {
  const bar = stepOf(metres * 110 * scale, 1.4);
  g.font = `${10.5 * scale}px system-ui, sans-serif`;
  g.textBaseline = "middle";
  g.textAlign = "left";
  g.fillStyle = colour;
  g.strokeStyle = halo;
  g.fillRect(10 * scale, h - 12 * scale, bar / metres, 3 * scale);
  g.lineWidth = 3 * scale;
  for (const [text, y] of [[bar >= 1000 ? `${bar / 1000} km` : `${bar} m`, h - 20 * scale], ["N ↑", 12 * scale]]) {
    g.strokeText(text, 12 * scale, y);
    g.fillText(text, 12 * scale, y);
  }
}

function spanOf(depths) {
  let low = Infinity, high = -Infinity;
  for (const d of depths) {
    if (d < low) low = d;
    if (d > high) high = d;
  }
  return low <= high ? [low, high] : null;
}

/** By how much to exaggerate the slopes of ground like this; none where there is none. */
function steepness(f) {
  const n = CELLS + 2;
  let sum = 0, count = 0;
  for (let k = n; k < f.floats.length - n; k += 7) {
    const slope = (f.floats[k + n] - f.floats[k - n]) / (2 * f.cell_m);
    if (Number.isFinite(slope)) {
      sum += slope * slope;
      count += 1;
    }
  }
  return count === 0 ? null : Math.max(1, Math.min(20, 0.3 / Math.sqrt(sum / count + 1e-9)));
}

/** A picture of a tile: the slope towards the light, tinted by depth. North is up. */
function shade(f, [low, high], steep) {
  const picture = document.createElement("canvas");
  picture.width = picture.height = CELLS;
  const g = picture.getContext("2d");
  const image = g.createImageData(CELLS, CELLS);
  const n = CELLS + 2;
  for (let row = 0; row < CELLS; row++) {
    for (let col = 0; col < CELLS; col++) {
      const k = (row + 1) * n + col + 1;
      const d = f.floats[k];
      const p = ((CELLS - 1 - row) * CELLS + col) * 4;
      if (Number.isNaN(d)) continue;
      const north = (steep * (f.floats[k + n] - f.floats[k - n])) / (2 * f.cell_m) || 0;
      const east = (steep * (f.floats[k + 1] - f.floats[k - 1])) / (2 * f.cell_m) || 0;
      // Depth grows downwards: the upward normal is (d/dnorth, d/deast, 1).
      const light = Math.max(0, (north * LIGHT[0] + east * LIGHT[1] + LIGHT[2]) / Math.hypot(north, east, 1));
      const t = Math.max(0, Math.min(1, (d - low) / (high - low)));
      const tint = [40 + 150 * (1 - t) ** 1.3, 70 + 120 * (1 - t), 110 + 60 * (1 - t)];
      for (let c = 0; c < 3; c++) image.data[p + c] = tint[c] * (0.25 + 0.9 * light);
      image.data[p + 3] = 255;
    }
  }
  g.putImageData(image, 0, 0);
  return picture;
}
