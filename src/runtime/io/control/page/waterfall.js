// The waterfall: a row a ping, the newest on top, port on the left. A sample is drawn at its slant range; of several in one pixel the loudest.
import { Contrast, byId, colourBar, degrees, ink, line as stroke, lookup, make, mapNames, painter, palette, pointer, say, stepOf, timeOf } from "./lib.js";
import { STEP_DB } from "./link.js";
import { saveData, savePicture } from "./save.js";

/** Lines kept for scrolling back. */
const MOST_LINES = 6000;
export const EARTH_M = 6371000;
/** Shares of the levels of the seabed that are black and brightest; of all levels, where no seabed is in sight. */
const OF_SEABED = [0.06, 0.998];
const OF_ALL = [0.36, 0.9995];
/** Range beyond the altitude at which the echo of the seabed has risen. */
const RISE = 1.02;
const RISE_M = 0.5;

export class Waterfall {
  constructor() {
    this.canvas = byId("wf");
    this.over = byId("wf-over");
    this.axis = byId("wf-axis");
    this.times = byId("wf-time");
    this.bar = byId("wf-bar");
    this.lines = [];
    this.back = 0; // rows scrolled back
    this.cursor = null; // {x share -1..1, row}
    this.contrast = new Contrast();
    this.off = new Map(); // of each target: its angle from broadside, one ping ago
    this.columns = new Map();
    for (const name of mapNames) byId("wf-map").append(make("option", { value: name, text: name }));
    this.paint = painter(this.canvas, (g, w, h, scale) => this.#draw(g, w, h, scale));
    this.paintOver = painter(this.over, (g, w, h, scale) => this.#drawOver(g, w, h, scale));
    this.paintAxis = painter(this.axis, (g, w, h, scale) => this.#drawAxis(g, w, h, scale));
    this.paintTimes = painter(this.times, (g, w, h, scale) => this.#drawTimes(g, w, h, scale));
    this.paintBar = painter(this.bar, (g, w, h, scale) => this.#drawBar(g, w, h, scale));
    this.#listen();
    this.recolour();
  }

  /** Another sonar, or another run. */
  clear() {
    this.lines = [];
    this.back = 0;
    this.off.clear();
    this.contrast = new Contrast();
    this.redraw();
  }

  add(frame) {
    const last = this.lines.at(-1);
    if (last && frame.ping <= last.ping) return false;
    this.#mark(frame, last);
    this.lines.push(frame);
    if (this.lines.length > MOST_LINES) this.lines.splice(0, this.lines.length - MOST_LINES);
    if (this.back > 0) this.back = Math.min(this.back + 1, this.lines.length - 1);
    const port = frame.pixels[0];
    this.contrast.add([0, 1].map((side) => [side === 0 ? frame.levels.subarray(0, port) : frame.levels.subarray(port), seabedPixel(frame, side)]), frame.low_db, STEP_DB);
    this.#auto();
    this.redraw();
    return true;
  }

  redraw() {
    this.paint();
    this.paintOver();
    this.paintAxis();
    this.paintTimes();
    this.paintBar();
  }

  recolour() {
    this.colours = palette(byId("wf-map").value);
    this.redraw();
  }

  /** A target's mark belongs to the ping that is broadside to it: where its angle changes sign, or is least before it is lost. */
  #mark(frame, last) {
    frame.marks = [];
    const now = new Map();
    for (const [name, side, delay, off, strength] of frame.expected) {
      const mark = { name, side, delay, strength, off };
      now.set(name, mark);
      const before = this.off.get(name);
      if (!before || Math.sign(before.off) === Math.sign(off) || !last) continue;
      if (Math.abs(before.off) < Math.abs(off)) last.marks.push(before);
      else frame.marks.push(mark);
    }
    this.off = now;
  }

  #auto() {
    if (!byId("wf-auto").checked) return;
    const [low, high] = this.contrast.span(OF_SEABED, OF_ALL);
    this.low = low;
    this.high = high;
    byId("wf-low").value = Math.round(low);
    byId("wf-high").value = Math.round(high);
  }

  get rowHeight() {
    return Number(byId("wf-rows").value);
  }

  /** The greatest range of the lines in sight, metres. */
  get range() {
    let range = 1;
    for (const line of this.#visible()) range = Math.max(range, line.range_m);
    return range;
  }

  #visible() {
    const rows = Math.ceil(this.canvas.height / this.rowHeight);
    const end = this.lines.length - this.back;
    return this.lines.slice(Math.max(0, end - rows), end).reverse();
  }

  /** Which parts of a line's row each pixel of one half shows: first, and one past the last. */
  #columnsOf(line, side, half, range) {
    const key = [side, half, range, line.pixels[side], line.samples, line.rate_hz, line.c, line.first_s].join(" ");
    let columns = this.columns.get(key);
    if (!columns) {
      columns = new Int32Array(half + 1);
      for (let x = 0; x <= half; x++) {
        const sample = ((2 * range * x) / half / line.c - line.first_s) * line.rate_hz;
        columns[x] = Math.floor((sample * line.pixels[side]) / line.samples);
      }
      if (this.columns.size > 16) this.columns.clear();
      this.columns.set(key, columns);
    }
    return columns;
  }

  #draw(g, w, h) {
    const range = this.range;
    const half = Math.floor(w / 2);
    const rowHeight = this.rowHeight;
    const image = g.createImageData(w, h);
    const pixels = new Uint32Array(image.data.buffer);
    const tables = new Map();
    let top = 0;
    for (const line of this.#visible()) {
      let table = tables.get(line.low_db);
      if (!table) {
        table = lookup(this.colours, line.low_db, STEP_DB, this.low ?? -60, this.high ?? 0);
        tables.set(line.low_db, table);
      }
      const row = pixels.subarray(top * w, (top + 1) * w).fill(this.colours[0]);
      let begin = 0;
      for (const side of [0, 1]) {
        const count = line.pixels[side];
        if (count > 0) {
          const columns = this.#columnsOf(line, side, half, range);
          const levels = line.levels.subarray(begin, begin + count);
          for (let x = 0; x < half; x++) {
            const first = columns[x], end = Math.max(first + 1, columns[x + 1]);
            if (first < 0 || first >= count) continue;
            let level = levels[first];
            for (let k = first + 1; k < end && k < count; k++) if (levels[k] > level) level = levels[k];
            row[side === 0 ? half - 1 - x : half + x] = table[level];
          }
        }
        begin += count;
      }
      for (let k = 1; k < rowHeight && top + k < h; k++) pixels.copyWithin((top + k) * w, top * w, (top + 1) * w);
      top += rowHeight;
      if (top >= h) break;
    }
    g.putImageData(image, 0, 0);
  }

  /** Place of a two-way time in the picture, pixels from the left. */
  xOf(side, delay, line, width) {
    const share = (delay * line.c) / 2 / this.range;
    return width / 2 + (side === 0 ? -share : share) * Math.floor(width / 2);
  }

  #drawOver(g, w, h, scale) {
    g.clearRect(0, 0, w, h);
    const visible = this.#visible();
    if (byId("wf-truth").checked) {
      g.font = `${10.5 * scale}px system-ui, sans-serif`;
      g.textBaseline = "middle";
      g.lineWidth = 1.5 * scale;
      visible.forEach((line, row) => {
        for (const mark of line.marks) {
          const x = this.xOf(mark.side, mark.delay, line, w);
          const y = (row + 0.5) * this.rowHeight;
          const r = 6 * scale;
          g.beginPath();
          g.moveTo(x - r, y);
          g.lineTo(x, y - r);
          g.lineTo(x + r, y);
          g.lineTo(x, y + r);
          g.closePath();
          g.strokeStyle = "#000a";
          g.lineWidth = 3.5 * scale;
          g.stroke();
          g.strokeStyle = ink("truth");
          g.lineWidth = 1.5 * scale;
          g.stroke();
          const left = x > w - 90 * scale;
          g.textAlign = left ? "right" : "left";
          const at = x + (left ? -r - 3 * scale : r + 3 * scale);
          g.lineWidth = 3 * scale;
          g.strokeStyle = "#000c";
          g.strokeText(mark.name, at, y);
          g.fillStyle = ink("truth");
          g.fillText(mark.name, at, y);
        }
      });
    }
    g.lineWidth = scale;
    g.strokeStyle = "#ffffff30";
    stroke(g, Math.floor(w / 2), 0, Math.floor(w / 2), h);
    g.font = `${10.5 * scale}px system-ui, sans-serif`;
    g.textBaseline = "top";
    g.lineWidth = 3 * scale;
    g.strokeStyle = "#000a";
    g.fillStyle = "#fffc";
    for (const [name, align, x] of [["port", "left", 6 * scale], ["starboard", "right", w - 6 * scale]]) {
      g.textAlign = align;
      g.strokeText(name, x, 5 * scale);
      g.fillText(name, x, 5 * scale);
    }
    g.lineWidth = scale;
    if (this.cursor) {
      g.strokeStyle = "#ffffffa0";
      g.setLineDash([4 * scale, 3 * scale]);
      const x = w / 2 + this.cursor.share * Math.floor(w / 2);
      const y = (this.cursor.row + 0.5) * this.rowHeight;
      stroke(g, x, 0, x, h);
      stroke(g, 0, y, w, y);
      g.setLineDash([]);
    }
    this.#read(visible);
  }

  #drawAxis(g, w, h, scale) {
    g.clearRect(0, 0, w, h);
    const range = this.range;
    const half = Math.floor(w / 2);
    const step = stepOf(range, half / (80 * scale));
    g.font = `${10.5 * scale}px system-ui, sans-serif`;
    g.fillStyle = ink("soft");
    g.strokeStyle = ink("soft");
    g.lineWidth = scale;
    g.textBaseline = "top";
    for (let r = 0; r <= range + 1e-6; r += step) {
      for (const sign of r === 0 ? [1] : [-1, 1]) {
        const x = w / 2 + (sign * r * half) / range;
        stroke(g, x, h - 4 * scale, x, h);
        g.textAlign = x < 30 * scale ? "left" : x > w - 30 * scale ? "right" : "center";
        g.fillText(r === 0 ? "0" : `${Math.round(r * 10) / 10} m`, x, scale);
      }
    }
  }

  /** Times and ping numbers of some rows, which move with them. */
  #drawTimes(g, w, h, scale) {
    g.clearRect(0, 0, w, h);
    g.font = `${10.5 * scale}px system-ui, sans-serif`;
    g.textAlign = "right";
    g.textBaseline = "middle";
    g.strokeStyle = ink("soft");
    g.lineWidth = scale;
    const step = stepOf((34 * scale) / this.rowHeight, 1);
    const visible = this.#visible();
    let free = 12 * scale; // where pings are missing, labels would overlap
    visible.forEach((line, row) => {
      const older = visible[row + 1];
      const y = (row + 0.5) * this.rowHeight;
      if (!older || Math.floor(line.ping / step) === Math.floor(older.ping / step) || y < free || y > h - 12 * scale) return;
      free = y + 28 * scale;
      stroke(g, w - 4 * scale, y, w, y);
      g.fillStyle = ink("ink");
      g.fillText(timeOf(line.t_ms, 0), w - 7 * scale, y - 6 * scale);
      g.fillStyle = ink("soft");
      g.fillText(`ping ${line.ping}`, w - 7 * scale, y + 7 * scale);
    });
  }

  #drawBar(g, w, h, scale) {
    g.clearRect(0, 0, w, h);
    colourBar(g, { x: 8 * scale, y: 20 * scale, height: h - 26 * scale }, scale, this.colours, this.low ?? -60, this.high ?? 0, "dB re 1 V");
  }

  savePicture(name, title) {
    savePicture(`${name}.png`, title, byId("wf-grid"), [this.axis, this.times, this.canvas, this.over, this.bar]);
  }

  /** The rows in sight, port and starboard one after the other. */
  saveData(name, title) {
    const rows = [];
    for (const line of this.#visible()) {
      const { nav } = line;
      for (const side of [0, 1]) {
        const count = line.pixels[side];
        if (count === 0) continue;
        const metres = ((line.c / 2) * line.samples) / line.rate_hz / count;
        const begin = side === 0 ? 0 : line.pixels[0];
        const levels = Array.from(line.levels.subarray(begin, begin + count), (v) => (v === 0 ? "" : (line.low_db + v * STEP_DB).toFixed(1)));
        rows.push([line.ping, new Date(line.t_ms).toISOString(), nav.lat.toFixed(7), nav.lon.toFixed(7), nav.heading.toFixed(2), line.altitude_m?.toFixed(2) ?? "", side === 0 ? "port" : "starboard", ((line.first_s * line.c) / 2).toFixed(4), metres.toFixed(5), ...levels]);
      }
    }
    const columns = ["ping", "utc", "latitude_deg", "longitude_deg", "heading_deg", "altitude_m", "side", "first_m", "step_m", "levels"];
    saveData(`${name}.csv`, [title, "levels in dB re 1 V rms, from nadir outwards: level k lies at the slant range first_m + k step_m; empty without a signal"], columns, rows);
  }

  #read(visible) {
    const newest = this.lines.at(-1);
    if (newest) say(byId("wf-from"), newest.of === "lines" ? "" : `maximum over all ${newest.of}`);
    if (!this.cursor) return;
    const line = visible[this.cursor.row];
    if (!line) return say(byId("wf-cursor"), "no ping at this position");
    const slant = Math.abs(this.cursor.share) * this.range;
    const side = this.cursor.share < 0 ? 0 : 1;
    const parts = [`ping ${line.ping}`, `${timeOf(line.t_ms, 2)} UTC`, `${side === 0 ? "port" : "starboard"} ${slant.toFixed(1)} m`, `${((2 * slant) / line.c * 1e3).toFixed(1)} ms`];
    const level = this.#levelAt(line, side, slant);
    if (level !== null) parts.push(`${level.toFixed(1)} dB`);
    const place = placeOf(line, side, slant);
    if (place) parts.push(`${place.across.toFixed(1)} m abeam on a flat bottom`, `${degrees(place.lat, "N", "S")} ${degrees(place.lon, "E", "W")}`);
    const near = line.marks.find((m) => m.side === side && Math.abs((m.delay * line.c) / 2 - slant) < this.range / 60);
    if (near) parts.push(`◇ ${near.name} at ${((near.delay * line.c) / 2).toFixed(1)} m`);
    say(byId("wf-cursor"), parts.join("   "));
  }

  #levelAt(line, side, slant) {
    const count = line.pixels[side];
    if (!count) return null;
    const sample = ((2 * slant) / line.c - line.first_s) * line.rate_hz;
    const k = Math.floor((sample * count) / line.samples);
    const level = line.levels[(side === 0 ? 0 : line.pixels[0]) + k];
    return k >= 0 && k < count && level > 0 ? line.low_db + level * STEP_DB : null;
  }

  #moveTo(x, y) {
    const half = Math.floor(this.canvas.width / 2);
    const rows = this.#visible().length;
    if (rows === 0) return;
    const row = Math.max(0, Math.min(rows - 1, Math.floor(y / this.rowHeight)));
    this.cursor = { share: Math.max(-1, Math.min(1, (x - this.canvas.width / 2) / half)), row };
    this.paintOver();
  }

  scroll(rows) {
    const most = Math.max(0, this.lines.length - 1);
    this.back = Math.max(0, Math.min(most, this.back + rows));
    byId("wf-live").hidden = this.back === 0;
    this.redraw();
  }

  #listen() {
    this.canvas.addEventListener("pointermove", (e) => this.#moveTo(...pointer(this.canvas, e)));
    this.canvas.addEventListener("pointerdown", (e) => this.#moveTo(...pointer(this.canvas, e)));
    this.canvas.addEventListener("pointerleave", () => {
      this.cursor = null;
      this.paintOver();
    });
    this.canvas.addEventListener("wheel", (e) => {
      e.preventDefault();
      this.scroll(Math.sign(e.deltaY) * 8);
    }, { passive: false });
    this.canvas.addEventListener("keydown", (e) => {
      const page = Math.floor((0.9 * this.canvas.height) / this.rowHeight);
      const moves = { PageDown: page, PageUp: -page, End: this.lines.length, Home: -this.lines.length };
      if (e.key in moves) this.scroll(moves[e.key]);
      else if (e.key.startsWith("Arrow")) {
        const at = this.cursor ?? { share: 0, row: 0 };
        const by = (e.shiftKey ? 10 : 1) * (e.key === "ArrowLeft" || e.key === "ArrowUp" ? -1 : 1);
        const across = e.key === "ArrowLeft" || e.key === "ArrowRight";
        const half = Math.floor(this.canvas.width / 2);
        this.#moveTo(this.canvas.width / 2 + at.share * half + (across ? by * 2 : 0), (at.row + (across ? 0 : by) + 0.5) * this.rowHeight);
      } else return;
      e.preventDefault();
    });
    byId("wf-map").addEventListener("change", () => this.recolour());
    byId("wf-rows").addEventListener("change", () => this.redraw());
    byId("wf-truth").addEventListener("change", () => this.redraw());
    byId("wf-auto").addEventListener("change", () => {
      this.#auto();
      this.redraw();
    });
    byId("wf-live").addEventListener("click", () => this.scroll(-this.lines.length));
    for (const id of ["wf-low", "wf-high"]) {
      byId(id).addEventListener("change", () => {
        byId("wf-auto").checked = false;
        this.low = Number(byId("wf-low").value);
        this.high = Number(byId("wf-high").value);
        this.redraw();
      });
    }
  }
}

/** Where a slant range lies on a flat bottom: metres abeam, latitude, longitude. */
export function placeOf(line, side, slant) {
  const { nav } = line;
  const height = nav.bottom === null ? NaN : nav.bottom - nav.down;
  if (!(slant >= height)) return null;
  const across = Math.sqrt(slant * slant - height * height);
  const bearing = ((nav.heading + (side === 0 ? -90 : 90)) * Math.PI) / 180;
  const lat = nav.lat + ((across * Math.cos(bearing)) / EARTH_M) * (180 / Math.PI);
  const lon = nav.lon + ((across * Math.sin(bearing)) / EARTH_M / Math.cos((nav.lat * Math.PI) / 180)) * (180 / Math.PI);
  return { across, lat, lon, north: nav.north + across * Math.cos(bearing), east: nav.east + across * Math.sin(bearing) };
}

/** Index of the first pixel of a line that belongs to the seabed; the number of pixels where the range ends before it or there is none. */
export function seabedPixel(line, side) {
  const count = line.pixels[side];
  if (line.altitude_m === null) return count;
  const slant = Math.max(0, line.altitude_m) * RISE + RISE_M;
  const pixel = Math.ceil((((2 * slant) / line.c - line.first_s) * line.rate_hz * count) / Math.max(1, line.samples));
  return Math.max(0, Math.min(count, pixel));
}
