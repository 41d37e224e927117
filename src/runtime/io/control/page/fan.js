// The fan: the water column under the sonar, beam by beam, in true angles and ranges.
import { Contrast, byId, digits, ink, lookup, painter, palette, pointer, say, stepOf } from "./lib.js";
import { STEP_DB } from "./link.js";

export class Fan {
  constructor() {
    this.canvas = byId("fan");
    this.frame = null;
    this.contrast = new Contrast();
    this.colours = palette("viridis");
    this.paint = painter(this.canvas, (g, w, h, scale) => this.#draw(g, w, h, scale));
    this.canvas.addEventListener("pointermove", (e) => {
      this.at = pointer(this.canvas, e);
      this.#read();
    });
    this.canvas.addEventListener("pointerleave", () => {
      this.at = null;
      this.#read();
    });
  }

  clear() {
    this.frame = null;
    this.contrast = new Contrast();
    this.paint();
  }

  add(frame) {
    this.frame = frame;
    this.contrast.add(frame.levels, frame.low_db, STEP_DB);
    this.paint();
    this.#read();
  }

  /** Apex, pixels to a metre, greatest range, angles at the edges. */
  #layout(w, h, scale) {
    const f = this.frame;
    const range = (f.c / 2) * (f.first_s + f.samples / f.rate_hz);
    const step = f.angles.length > 1 ? f.angles[1] - f.angles[0] : 1;
    const widest = Math.min(89, Math.max(Math.abs(f.angles[0]), Math.abs(f.angles.at(-1))) + Math.abs(step) / 2);
    const sin = Math.sin((widest * Math.PI) / 180);
    const top = 6 * scale;
    const perMetre = Math.min((w / 2 - 40 * scale) / (range * sin), (h - top - 16 * scale) / range);
    return { x0: w / 2, y0: top, perMetre, range, widest };
  }

  #draw(g, w, h, scale) {
    g.clearRect(0, 0, w, h);
    const f = this.frame;
    if (!f) return nothing(g, w, h, scale, "this sonar has no fan, or no ping has arrived");
    const at = this.#layout(w, h, scale);
    const key = [w, h, f.beams, f.bins, at.range, f.first_s, f.angles[0]].join(" ");
    if (this.key !== key) this.#plan(key, w, h, at);
    const [low, high] = this.contrast.span(0.3, 0.9995, 30);
    const table = lookup(this.colours, f.low_db, STEP_DB, low, high);
    const image = g.createImageData(w, h);
    const pixels = new Uint32Array(image.data.buffer);
    for (let k = 0; k < this.pixels.length; k++) pixels[this.pixels[k]] = table[f.levels[this.cells[k]]];
    g.putImageData(image, 0, 0);
    g.font = `${10.5 * scale}px system-ui, sans-serif`;
    g.lineWidth = scale;
    const rad = (deg) => (deg * Math.PI) / 180;
    const step = stepOf(at.range, 4);
    g.strokeStyle = "#ffffff2c";
    g.fillStyle = ink("soft");
    g.textAlign = "left";
    for (let r = step; r <= at.range + 1e-6; r += step) {
      g.beginPath();
      g.arc(at.x0, at.y0, r * at.perMetre, rad(90 - at.widest), rad(90 + at.widest));
      g.stroke();
      const x = at.x0 + r * at.perMetre * Math.sin(rad(at.widest));
      g.fillText(`${Math.round(r)} m`, x + 5 * scale, Math.min(h - 3 * scale, at.y0 + r * at.perMetre * Math.cos(rad(at.widest)) + 2 * scale));
    }
    g.fillStyle = ink("truth");
    for (const [angle, time, byPhase] of f.soundings) {
      const r = ((time * f.c) / 2) * at.perMetre;
      const x = at.x0 + r * Math.sin(rad(angle)), y = at.y0 + r * Math.cos(rad(angle));
      g.beginPath();
      g.arc(x, y, (byPhase ? 1.6 : 2.4) * scale, 0, 7);
      g.fill();
    }
  }

  /** Which pixel shows which cell of the frame. */
  #plan(key, w, h, at) {
    const f = this.frame;
    const pixels = [], cells = [];
    const edges = f.angles.map((a, k) => (k === 0 ? -90 : (a + f.angles[k - 1]) / 2));
    for (let y = 0; y < h; y++) {
      for (let x = 0; x < w; x++) {
        const across = (x + 0.5 - at.x0) / at.perMetre, down = (y + 0.5 - at.y0) / at.perMetre;
        const angle = (Math.atan2(across, down) * 180) / Math.PI;
        const range = Math.hypot(across, down);
        if (range > at.range || Math.abs(angle) > at.widest) continue;
        let a = 0, b = edges.length - 1;
        while (a < b) {
          const m = (a + b + 1) >> 1;
          if (edges[m] <= angle) a = m;
          else b = m - 1;
        }
        const bin = Math.floor((((2 * range) / f.c - f.first_s) * f.rate_hz * f.bins) / f.samples);
        if (bin < 0 || bin >= f.bins) continue;
        pixels.push(y * w + x);
        cells.push(a * f.bins + bin);
      }
    }
    this.key = key;
    this.pixels = new Int32Array(pixels);
    this.cells = new Int32Array(cells);
  }

  #read() {
    const f = this.frame;
    if (!f) return say(byId("fan-cursor"), "");
    const parts = [`ping ${f.ping}`, `${f.all_beams} beams`, `${f.soundings.length} soundings`];
    if (this.at && this.canvas.width > 8) {
      const l = this.#layout(this.canvas.width, this.canvas.height, this.canvas.scale ?? 1);
      const across = (this.at[0] - l.x0) / l.perMetre, down = (this.at[1] - l.y0) / l.perMetre;
      parts.push(`${digits((Math.atan2(across, down) * 180) / Math.PI, 1)}°`, `${digits(Math.hypot(across, down), 1)} m`, `${digits(across, 1)} m across, ${digits(down, 1)} m below`);
    }
    say(byId("fan-cursor"), parts.join("   "));
  }
}

export function nothing(g, w, h, scale, text) {
  g.fillStyle = ink("soft");
  g.font = `${12 * scale}px system-ui, sans-serif`;
  g.textAlign = "center";
  g.fillText(text, w / 2, h / 2);
}
