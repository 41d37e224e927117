// The fan: the water column under the sonar, beam by beam, in true angles and ranges.
import { Contrast, byId, colourBar, digits, followPointer, ink, line, lookup, painter, palette, say, stepOf } from "./lib.js";
import { STEP_DB } from "./link.js";
import { saveData, savePicture } from "./save.js";

/** Shares of the levels that are darkest and brightest: the water column is dark. */
const SHARES = [0.3, 0.9995];

export class Fan {
  constructor() {
    this.canvas = byId("fan");
    this.frame = null;
    this.contrast = new Contrast();
    this.colours = palette("viridis");
    this.paint = painter(this.canvas, (g, w, h, scale) => this.#draw(g, w, h, scale));
    followPointer(this, () => this.#read());
  }

  clear() {
    this.frame = null;
    this.contrast = new Contrast();
    this.paint();
  }

  add(frame) {
    this.frame = frame;
    this.contrast.add([[frame.levels, frame.levels.length]], frame.low_db, STEP_DB);
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
    const top = 8 * scale;
    // Depths are written to the left, the colour bar lies to the right.
    const left = 62 * scale, right = 74 * scale;
    const perMetre = Math.min((w - left - right) / 2 / (range * sin), (h - top - 18 * scale) / range);
    return { x0: (left + w - right) / 2, y0: top, perMetre, range, widest };
  }

  #draw(g, w, h, scale) {
    g.clearRect(0, 0, w, h);
    const f = this.frame;
    if (!f) return nothing(g, w, h, scale, "this sonar has no fan, or no ping has arrived");
    const at = this.#layout(w, h, scale);
    const key = [w, h, f.beams, f.bins, at.range, f.first_s, f.angles[0]].join(" ");
    if (this.key !== key) this.#plan(key, w, h, at);
    const [low, high] = this.contrast.span(SHARES, SHARES, 30);
    const table = lookup(this.colours, f.low_db, STEP_DB, low, high);
    const image = g.createImageData(w, h);
    const pixels = new Uint32Array(image.data.buffer);
    for (let k = 0; k < this.pixels.length; k++) pixels[this.pixels[k]] = table[f.levels[this.cells[k]]];
    g.putImageData(image, 0, 0);
    g.font = `${10.5 * scale}px system-ui, sans-serif`;
    g.lineWidth = scale;
    this.#grid(g, h, at, scale);
    colourBar(g, { x: w - 50 * scale, y: 22 * scale, height: h - 30 * scale }, scale, this.colours, low, high, "dB re 1 V");
    const rad = (deg) => (deg * Math.PI) / 180;
    g.fillStyle = ink("truth");
    for (const [angle, time, byPhase] of f.soundings) {
      const r = ((time * f.c) / 2) * at.perMetre;
      const x = at.x0 + r * Math.sin(rad(angle)), y = at.y0 + r * Math.cos(rad(angle));
      g.beginPath();
      g.arc(x, y, (byPhase ? 1.6 : 2.4) * scale, 0, 7);
      g.fill();
    }
  }

  /** Lines of equal depth below the sonar and of equal angle, and the arc of the range. */
  #grid(g, h, at, scale) {
    const rad = (deg) => (deg * Math.PI) / 180;
    const end = (angle, r) => [at.x0 + r * at.perMetre * Math.sin(rad(angle)), at.y0 + r * at.perMetre * Math.cos(rad(angle))];
    g.strokeStyle = "#ffffff38";
    g.fillStyle = ink("soft");
    g.textBaseline = "middle";
    g.textAlign = "right";
    const step = stepOf(at.range, Math.max(2, (at.range * at.perMetre) / (32 * scale)));
    for (let depth = step; depth < at.range * 0.995; depth += step) {
      // As wide as the fan is at this depth.
      const half = Math.min(Math.sqrt(at.range ** 2 - depth ** 2), depth * Math.tan(rad(at.widest)));
      const y = at.y0 + depth * at.perMetre;
      line(g, at.x0 - half * at.perMetre, y, at.x0 + half * at.perMetre, y);
      line(g, 40 * scale, y, 44 * scale, y);
      g.fillText(`${Math.round(depth * 10) / 10} m`, 37 * scale, y);
    }
    g.textAlign = "center";
    g.textBaseline = "top";
    const turn = at.widest > 30 ? 15 : at.widest > 12 ? 5 : 2;
    for (let angle = -Math.floor(at.widest / turn) * turn; angle <= at.widest; angle += turn) {
      const [x, y] = end(angle, at.range);
      line(g, at.x0, at.y0, x, y);
      g.fillText(`${angle}°`, x + 8 * scale * Math.sin(rad(angle)), Math.min(h - 12 * scale, y + 3 * scale));
    }
    g.beginPath();
    g.arc(at.x0, at.y0, at.range * at.perMetre, rad(90 - at.widest), rad(90 + at.widest));
    g.stroke();
  }

  get isEmpty() {
    return this.frame === null;
  }

  savePicture(name, title) {
    savePicture(`${name}.png`, title, this.canvas, [this.canvas]);
  }

  /** One row a beam. */
  saveData(name, title) {
    const f = this.frame;
    const metres = ((f.c / 2) * f.samples) / f.rate_hz / f.bins;
    const rows = f.angles.map((angle, k) => [angle.toFixed(3), ...Array.from(f.levels.subarray(k * f.bins, (k + 1) * f.bins), (v) => (v === 0 ? "" : (f.low_db + v * STEP_DB).toFixed(1)))]);
    const about = `levels in dB re 1 V rms: level k lies at ${((f.first_s * f.c) / 2).toFixed(4)} m + k ${metres.toFixed(5)} m; empty without a signal`;
    saveData(`${name}.csv`, [title, about], ["angle_deg", "levels"], rows);
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
    const parts = [`ping ${f.ping}`, `${f.all_beams} beams`];
    if (f.soundings.length) parts.push(`${f.soundings.length} soundings`);
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
