// The A-scope: samples of one element, beam or line as envelope, I and Q, or spectrum.
import { axes, byId, digits, followPointer, ink, make, painter, say } from "./lib.js";
import { nothing } from "./fan.js";
import { saveData, savePicture } from "./save.js";

export class Scope {
  constructor(changed) {
    this.canvas = byId("scope");
    this.frame = null;
    this.rig = null;
    this.paint = painter(this.canvas, (g, w, h, scale) => this.#draw(g, w, h, scale));
    byId("scope-of").addEventListener("change", () => {
      this.#arrays();
      changed();
    });
    for (const id of ["scope-array", "scope-index"]) byId(id).addEventListener("change", changed);
    byId("scope-show").addEventListener("change", this.paint);
    followPointer(this, () => this.paint());
  }

  /** Another sonar. */
  sonar(rig) {
    this.rig = rig;
    this.frame = null;
    for (const [value, has] of [["beam", rig.beams > 0], ["line", rig.lines.length > 0]]) byId("scope-of").querySelector(`[value=${value}]`).disabled = !has;
    byId("scope-of").value = "element";
    this.#arrays();
    this.paint();
  }

  #arrays() {
    const of = byId("scope-of").value;
    const names = of === "element" ? this.rig.arrays.map((a) => a.name) : of === "beam" ? ["fan"] : this.rig.lines;
    byId("scope-array").replaceChildren(...names.map((name, k) => make("option", { value: k, text: name })));
    byId("scope-index").disabled = of === "line";
    this.#bound();
  }

  #bound() {
    const array = Number(byId("scope-array").value || 0);
    const of = byId("scope-of").value;
    const count = of === "element" ? this.rig.arrays[array].elements : of === "beam" ? this.rig.beams : 1;
    const index = byId("scope-index");
    index.max = count - 1;
    index.value = Math.max(0, Math.min(count - 1, Math.floor(Number(index.value) || 0)));
  }

  /** What it asks the daemon for. */
  get want() {
    this.#bound();
    return { of: byId("scope-of").value, array: Number(byId("scope-array").value || 0), index: Number(byId("scope-index").value), first: 0 };
  }

  add(frame) {
    this.frame = frame;
    this.paint();
  }

  get isEmpty() {
    return !this.frame || this.frame.floats.length === 0;
  }

  savePicture(name, title) {
    savePicture(`${name}.png`, title, this.canvas, [this.canvas]);
  }

  saveData(name, title) {
    const f = this.frame;
    const rows = Array.from({ length: f.floats.length / 2 }, (_, k) => [(f.first_s + (f.first + k) / f.rate_hz).toFixed(9), f.floats[2 * k], f.floats[2 * k + 1]]);
    saveData(`${name}.csv`, [title, `${byId("scope-of").value} ${byId("scope-index").value} of ${byId("scope-array").selectedOptions[0]?.text}, ping ${f.ping}; seconds from the start of the pulse, volts`], ["time_s", "i_v", "q_v"], rows);
  }

  #draw(g, w, h, scale) {
    g.clearRect(0, 0, w, h);
    const f = this.frame;
    if (!f || f.floats.length === 0) return nothing(g, w, h, scale, "waiting for samples");
    const show = byId("scope-show").value;
    const n = f.floats.length / 2;
    const start = (f.first_s + f.first / f.rate_hz) * 1e3;
    const ms = (k) => start + (k / f.rate_hz) * 1e3;
    const series = [];
    let x, y;
    if (show === "spectrum") {
      const db = spectrum(f.floats, n);
      const peak = Math.max(...db);
      x = { from: (f.center_hz - f.rate_hz / 2) / 1e3, to: (f.center_hz + f.rate_hz / 2) / 1e3, name: "kHz" };
      if (!f.complex) x = { from: -f.rate_hz / 2e3, to: f.rate_hz / 2e3, name: "kHz, baseband" };
      y = { from: Math.floor(peak / 10) * 10 - 80, to: Math.ceil(peak / 10) * 10, name: "dB re 1 V" };
      series.push([ink("accent"), db, (k) => x.from + ((x.to - x.from) * k) / db.length]);
    } else if (show === "iq") {
      const top = f.floats.reduce((m, v) => Math.max(m, Math.abs(v)), 1e-12);
      x = { from: ms(0), to: ms(n), name: "ms" };
      y = { from: -top, to: top, name: "V" };
      series.push([ink("accent"), pick(f.floats, 0, n), ms], [ink("warn"), pick(f.floats, 1, n), ms]);
    } else {
      const db = new Float32Array(n);
      let peak = -600;
      for (let k = 0; k < n; k++) {
        db[k] = 10 * Math.log10(f.floats[2 * k] ** 2 + f.floats[2 * k + 1] ** 2 + 1e-60);
        if (db[k] > peak) peak = db[k];
      }
      x = { from: ms(0), to: ms(n), name: "ms" };
      y = { from: Math.ceil(peak / 10) * 10 - 80, to: Math.ceil(peak / 10) * 10, name: "dB re 1 V" };
      series.push([ink("accent"), db, ms]);
    }
    const plot = axes(g, w, h, scale, x, y);
    g.save();
    g.beginPath();
    g.rect(plot.left, plot.top, plot.right - plot.left, plot.bottom - plot.top);
    g.clip();
    for (const [colour, values, at] of series) curve(g, colour, values, at, plot, scale);
    g.restore();
    const parts = [`ping ${f.ping}`, `${f.all} samples at ${f.rate_hz / 1e3} kHz`];
    if (f.all > n) parts.push(`the first ${n}`);
    if (this.at && this.at[0] > plot.left && this.at[0] < plot.right) {
      const value = x.from + ((this.at[0] - plot.left) / (plot.right - plot.left)) * (x.to - x.from);
      parts.push(`${digits(value, 3)} ${x.name}`);
      if (show !== "spectrum") parts.push(`${digits((value / 1e3) * f.c / 2, 2)} m`);
      g.strokeStyle = ink("soft");
      g.beginPath();
      g.moveTo(this.at[0], plot.top);
      g.lineTo(this.at[0], plot.bottom);
      g.stroke();
    }
    say(byId("scope-cursor"), parts.join("   "));
  }
}

const pick = (floats, from, n) => Float32Array.from({ length: n }, (_, k) => floats[2 * k + from]);

/** Of many values in one pixel, the least and the greatest. */
function curve(g, colour, values, at, plot, scale) {
  g.strokeStyle = colour;
  g.lineWidth = 1.2 * scale;
  g.beginPath();
  let column = NaN, low = 0, high = 0, begun = false;
  const flush = () => {
    if (Number.isNaN(column)) return;
    if (begun) g.lineTo(column, plot.py(high));
    else g.moveTo(column, plot.py(high));
    if (low < high) g.lineTo(column, plot.py(low));
    begun = true;
  };
  for (let k = 0; k < values.length; k++) {
    const x = Math.round(plot.px(at(k)));
    if (x === column) {
      low = Math.min(low, values[k]);
      high = Math.max(high, values[k]);
    } else {
      flush();
      column = x;
      low = high = values[k];
    }
  }
  flush();
  g.stroke();
}

/** Power of the row under a Hann window, dB, from the lowest frequency up. */
export function spectrum(floats, n) {
  const size = 2 ** Math.ceil(Math.log2(Math.max(2, n)));
  const re = new Float64Array(size), im = new Float64Array(size);
  let gain = 0;
  for (let k = 0; k < n; k++) {
    const hann = 0.5 - 0.5 * Math.cos((2 * Math.PI * (k + 0.5)) / n);
    gain += hann;
    re[k] = floats[2 * k] * hann;
    im[k] = floats[2 * k + 1] * hann;
  }
  fft(re, im);
  return Float64Array.from({ length: size }, (_, k) => {
    const j = (k + size / 2) % size;
    return 10 * Math.log10((re[j] ** 2 + im[j] ** 2) / gain ** 2 + 1e-60);
  });
}

/** In place, radix 2. */
export function fft(re, im) {
  const n = re.length;
  for (let i = 1, j = 0; i < n; i++) {
    let bit = n >> 1;
    for (; j & bit; bit >>= 1) j ^= bit;
    j ^= bit;
    if (i < j) {
      [re[i], re[j]] = [re[j], re[i]];
      [im[i], im[j]] = [im[j], im[i]];
    }
  }
  for (let length = 2; length <= n; length <<= 1) {
    const half = length >> 1;
    for (let k = 0; k < half; k++) {
      const angle = (-2 * Math.PI * k) / length;
      const c = Math.cos(angle), s = Math.sin(angle);
      for (let i = k; i < n; i += length) {
        const j = i + half;
        const x = re[j] * c - im[j] * s, y = re[j] * s + im[j] * c;
        re[j] = re[i] - x;
        im[j] = im[i] - y;
        re[i] += x;
        im[i] += y;
      }
    }
  }
}
