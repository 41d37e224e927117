// The bathymetry: bottom detections from above, north up, coloured by depth.
import { byId, colourBar, digits, followPointer, ink, painter, palette, say } from "./lib.js";
import { nothing } from "./fan.js";
import { EARTH_M } from "./waterfall.js";
import { saveData, savePicture } from "./save.js";
import { drawScaleBar, drawShip } from "./track.js";

/** Pings kept. */
const MOST_PINGS = 2000;
/** Shares of the depths at the ends of the colours: a few false detections do not count. */
const SHARES = [0.01, 0.99];

export class Bathymetry {
  constructor() {
    this.canvas = byId("bathymetry");
    this.colours = palette("rainbow"); // from deep to shallow
    this.paint = painter(this.canvas, (g, w, h, scale) => this.#draw(g, w, h, scale));
    followPointer(this, () => this.#read());
    this.clear();
  }

  clear() {
    this.pings = [];
    this.nav = null;
    this.paint();
  }

  /** Triples of north, east and depth of one ping. */
  add(frame) {
    const last = this.pings.at(-1);
    if (last && frame.ping <= last.ping) return;
    this.pings.push({ ping: frame.ping, points: frame.floats });
    if (this.pings.length > MOST_PINGS) this.pings.splice(0, this.pings.length - MOST_PINGS);
    this.paint();
  }

  ship(frame) {
    this.nav = frame.nav;
  }

  get isEmpty() {
    return this.pings.length === 0;
  }

  savePicture(name, title) {
    savePicture(`${name}.png`, title, this.canvas, [this.canvas]);
  }

  saveData(name, title) {
    const { lat, lon, north, east } = this.nav;
    const degrees = 180 / Math.PI / EARTH_M;
    const rows = [];
    for (const { ping, points } of this.pings) {
      for (let k = 0; k < points.length; k += 3) {
        const [n, e, d] = points.subarray(k, k + 3);
        const latitude = lat + (n - north) * degrees;
        rows.push([ping, latitude.toFixed(7), (lon + ((e - east) * degrees) / Math.cos((lat * Math.PI) / 180)).toFixed(7), n.toFixed(3), e.toFixed(3), d.toFixed(3)]);
      }
    }
    saveData(`${name}.csv`, [title], ["ping", "latitude_deg", "longitude_deg", "north_m", "east_m", "depth_m"], rows);
  }

  /** Bounds of the soundings and the depths at the ends of the colours. */
  #bounds() {
    const box = { north: [Infinity, -Infinity], east: [Infinity, -Infinity] };
    const depths = [];
    for (const { points } of this.pings) {
      for (let k = 0; k < points.length; k += 3) {
        const [n, e] = [points[k], points[k + 1]];
        if (n < box.north[0]) box.north[0] = n;
        if (n > box.north[1]) box.north[1] = n;
        if (e < box.east[0]) box.east[0] = e;
        if (e > box.east[1]) box.east[1] = e;
        // A sample of the depths is enough.
        if (k % 21 === 0) depths.push(points[k + 2]);
      }
    }
    depths.sort((a, b) => a - b);
    const at = (share) => depths[Math.min(depths.length - 1, Math.floor(share * depths.length))];
    let [shallow, deep] = SHARES.map(at);
    if (deep - shallow < 0.2) [shallow, deep] = [(shallow + deep) / 2 - 0.1, (shallow + deep) / 2 + 0.1];
    return { ...box, shallow, deep };
  }

  #draw(g, w, h, scale) {
    g.clearRect(0, 0, w, h);
    this.drawn = null;
    if (this.isEmpty) return nothing(g, w, h, scale, "no bottom detection has arrived");
    const b = this.#bounds();
    const right = w - 60 * scale, margin = 18 * scale;
    const metres = Math.max((b.east[1] - b.east[0]) / (right - 2 * margin), (b.north[1] - b.north[0]) / (h - 2 * margin), 0.01);
    const middle = [(b.east[0] + b.east[1]) / 2, (b.north[0] + b.north[1]) / 2];
    const X = (east) => right / 2 + (east - middle[0]) / metres;
    const Y = (north) => h / 2 - (north - middle[1]) / metres;
    const image = g.createImageData(w, h);
    const pixels = new Uint32Array(image.data.buffer);
    const depths = new Float32Array(w * h).fill(NaN);
    // A dot is as large as the distance of soundings, so that no gaps show: the mean of the box over their number.
    const count = this.pings.reduce((sum, p) => sum + p.points.length / 3, 0);
    const area = ((b.east[1] - b.east[0]) * (b.north[1] - b.north[0])) / metres ** 2;
    const half = Math.max(1, Math.min(4, Math.round(0.8 * Math.sqrt(area / count))));
    for (const { points } of this.pings) {
      for (let k = 0; k < points.length; k += 3) {
        const x = Math.round(X(points[k + 1])), y = Math.round(Y(points[k])), depth = points[k + 2];
        const colour = this.colours[Math.max(0, Math.min(255, Math.round((255 * (b.deep - depth)) / (b.deep - b.shallow))))];
        for (let j = Math.max(0, y - half); j <= Math.min(h - 1, y + half); j++) {
          for (let i = Math.max(0, x - half); i <= Math.min(w - 1, x + half); i++) {
            pixels[j * w + i] = colour;
            depths[j * w + i] = depth;
          }
        }
      }
    }
    g.putImageData(image, 0, 0);
    this.drawn = { w, h, metres, middle, right, depths };
    if (this.nav) drawShip(g, X(this.nav.east), Y(this.nav.north), this.nav.heading, scale);
    drawScaleBar(g, h, metres, scale, ink("ink"), ink("well"));
    colourBar(g, { x: w - 50 * scale, y: 22 * scale, height: h - 30 * scale }, scale, this.colours, b.deep, b.shallow, "depth, m");
    this.span = b;
    this.#read();
  }

  #read() {
    const last = this.pings.at(-1);
    if (!last) return say(byId("bathymetry-cursor"), "");
    const parts = [`ping ${last.ping}`, `${last.points.length / 3} soundings`];
    if (this.span) parts.push(`${digits(this.span.shallow, 1)} to ${digits(this.span.deep, 1)} m deep`);
    if (this.at && this.drawn) {
      const { w, depths, metres, middle, right, h } = this.drawn;
      const [x, y] = this.at.map(Math.floor);
      const depth = depths[y * w + x];
      parts.push(`north ${digits(middle[1] + (h / 2 - y) * metres, 1)} m, east ${digits(middle[0] + (x - right / 2) * metres, 1)} m`, `depth ${digits(depth, 2)} m`);
    }
    say(byId("bathymetry-cursor"), parts.join("   "));
  }
}
