// The elements at a glance: level and peak of each, and what is wrong with it.
import { byId, digits, ink, line, painter, pointer, say, stepOf } from "./lib.js";
import { nothing } from "./fan.js";
import { saveData, savePicture } from "./save.js";

export class Elements {
  constructor(look) {
    this.canvas = byId("elements");
    this.frame = null;
    this.faults = [];
    this.at = null;
    this.cells = [];
    this.paint = painter(this.canvas, (g, w, h, scale) => this.#draw(g, w, h, scale));
    this.canvas.addEventListener("pointermove", (e) => {
      this.at = pointer(this.canvas, e);
      this.#read();
    });
    this.canvas.addEventListener("click", () => {
      const cell = this.#under();
      if (cell) look(cell.array, cell.element);
    });
  }

  sonar(rig) {
    this.rig = rig;
    this.frame = null;
    this.paint();
  }

  add(frame) {
    this.frame = frame;
    this.paint();
    this.#read();
  }

  /** Scheduled faults of elements. */
  setFaults(faults, sonar) {
    this.faults = faults.filter((f) => !f.sonar || f.sonar === sonar);
    this.paint();
  }

  #faultOf(array, element) {
    const f = this.faults.find((f) => (f.array ?? array) === array && (f.element === undefined || f.element === element || f.other === element && f.kind === "swapped"));
    return f ? f.kind : null;
  }

  #draw(g, w, h, scale) {
    g.clearRect(0, 0, w, h);
    const f = this.frame;
    this.cells = [];
    if (!f || !this.rig) return nothing(g, w, h, scale, "waiting for a ping");
    const levels = f.floats;
    let top = -600;
    for (const v of levels) if (v > top) top = v;
    top = Math.ceil(top / 10) * 10;
    const span = 90;
    const rows = this.rig.arrays.length;
    const rowHeight = h / rows;
    g.font = `${10.5 * scale}px system-ui, sans-serif`;
    let begin = 0;
    this.rig.arrays.forEach((array, a) => {
      const y0 = a * rowHeight + 16 * scale, y1 = (a + 1) * rowHeight - 6 * scale;
      const left = 40 * scale, right = w - 8 * scale;
      const y = (db) => y1 - Math.max(0, Math.min(1, (db - top + span) / span)) * (y1 - y0);
      g.fillStyle = ink("soft");
      g.textAlign = "left";
      const saturated = f.arrays[a]?.saturated ? `, ${f.arrays[a].saturated} values at full scale` : "";
      g.fillText(`${array.name}: ${array.elements} elements, rms and peak, dB re 1 V${saturated}`, left, y0 - 5 * scale);
      g.strokeStyle = ink("line");
      g.lineWidth = scale;
      g.textAlign = "right";
      for (let db = top; db >= top - span; db -= stepOf(span, (y1 - y0) / (22 * scale))) {
        line(g, left, y(db), right, y(db));
        g.fillText(String(db), left - 4 * scale, y(db) + 4 * scale);
      }
      const width = (right - left) / array.elements;
      for (let e = 0; e < array.elements; e++) {
        const rms = levels[begin + 2 * e], peak = levels[begin + 2 * e + 1];
        const fault = this.#faultOf(a, e);
        const x = left + e * width, bar = Math.max(1, width * 0.78);
        g.fillStyle = ink(fault ? "bad" : "accent");
        g.fillRect(x, y(rms), bar, y1 - y(rms));
        g.fillStyle = ink(fault ? "bad" : "warn");
        g.fillRect(x, y(peak) - scale, bar, 2 * scale);
        if (fault) {
          // Not by colour alone.
          g.fillStyle = ink("bad");
          g.textAlign = "center";
          g.fillText("✕", x + bar / 2, y0 + 9 * scale);
        }
        this.cells.push({ array: a, element: e, x0: x, x1: x + width, y0: a * rowHeight, y1: (a + 1) * rowHeight, rms, peak, fault });
      }
      begin += 2 * array.elements;
    });
  }

  get isEmpty() {
    return this.cells.length === 0;
  }

  savePicture(name, title) {
    savePicture(`${name}.png`, title, this.canvas, [this.canvas]);
  }

  saveData(name, title) {
    const rows = this.cells.map((c) => [this.rig.arrays[c.array].name, c.element, c.rms.toFixed(2), c.peak.toFixed(2), c.fault ?? ""]);
    saveData(`${name}.csv`, [title], ["array", "element", "rms_db_re_1_v", "peak_db_re_1_v", "fault"], rows);
  }

  #under() {
    if (!this.at) return null;
    const [x, y] = this.at;
    return this.cells.find((c) => x >= c.x0 && x < c.x1 && y >= c.y0 && y < c.y1) ?? null;
  }

  #read() {
    const spoiled = this.cells.filter((c) => c.fault);
    const cell = this.#under();
    const all = spoiled.length === 0 ? "no element faults" : `${spoiled.length} with a fault: ${[...new Set(spoiled.map((c) => c.fault))].join(", ")}`;
    if (!cell) return say(byId("elements-cursor"), this.frame ? `ping ${this.frame.ping}   ${all}   click an element for its A-scope` : "");
    const name = this.rig.arrays[cell.array].name;
    say(byId("elements-cursor"), `${name} ${cell.element}   rms ${digits(cell.rms, 1)} dB   peak ${digits(cell.peak, 1)} dB   ${cell.fault ?? "no fault"}`);
  }
}
