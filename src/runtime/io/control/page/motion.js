// Attitude of late, and how good the navigation is, source by source.
import { byId, digits, ink, line, make, painter, stepOf } from "./lib.js";
import { savePicture } from "./save.js";

const STRIPS = [["roll", "°", 4], ["pitch", "°", 4], ["heave", "m", 1], ["heading", "°", 4]];
const SHOWN_S = 120;
const WELL = { ok: "good", hold: "warn", stale: "bad", lost: "bad", silent: "warn" };

export class Motion {
  constructor() {
    this.canvas = byId("motion");
    this.paint = painter(this.canvas, (g, w, h, scale) => this.#draw(g, w, h, scale));
    this.clear();
  }

  clear() {
    this.lines = [];
    this.paint();
  }

  add(frame) {
    this.lines.push({ t: frame.t_ms / 1e3, nav: frame.nav });
    if (this.lines.length > 6000) this.lines.splice(0, 1000);
    this.paint();
  }

  get isEmpty() {
    return this.lines.length === 0;
  }

  savePicture(name, title) {
    savePicture(`${name}.png`, title, this.canvas, [this.canvas]);
  }

  sources(nav, owners) {
    const owned = (source) => Object.entries(owners).filter(([, name]) => name === source).map(([quantity]) => quantity).join(", ");
    const heads = ["Source", "Active for", "State", "Read", "Used", "Wrong checksum", "Malformed", "Jumps", "Lost"];
    const rows = nav.map((s) => make("tr", {},
      make("th", { scope: "row", text: s.name }),
      make("td", { text: owned(s.name) || "nothing" }),
      make("td", { is: WELL[s.state] ?? "bad", text: s.state }),
      ...[s.sentences, s.used, s.bad_checksum, s.malformed, s.time_jumps, s.dropped].map((n, k) => make("td", { text: String(n), is: k >= 2 && n > 0 ? "warn" : null }))));
    const last = this.lines.at(-1)?.nav;
    const foot = [];
    if (last) {
      const bad = Object.entries(last.invalid).filter(([, is]) => is).map(([name]) => name.replace("_", " and "));
      const quality = bad.length ? `invalid: ${bad.join(", ")}` : last.extrapolated ? "extrapolated" : "measured on both sides";
      foot.push(make("tr", {}, make("th", { scope: "row", text: "Last ping" }), make("td", { colspan: 8, is: bad.length ? "bad" : last.extrapolated ? "warn" : "good", text: `${quality}; position ${age(last.position_age)}, attitude ${age(last.attitude_age)}, fix ${last.fix}` })));
    }
    byId("nav-sources").replaceChildren(
      make("caption", { text: "Sources" }),
      make("thead", {}, make("tr", {}, ...heads.map((text) => make("th", { scope: "col", text })))),
      make("tbody", {}, ...rows, ...foot));
  }

  #draw(g, w, h, scale) {
    g.clearRect(0, 0, w, h);
    const last = this.lines.at(-1);
    if (!last) return;
    const shown = this.lines.filter((l) => l.t > last.t - SHOWN_S);
    const left = 46 * scale, right = w - 60 * scale;
    g.font = `${10.5 * scale}px system-ui, sans-serif`;
    g.textBaseline = "middle";
    STRIPS.forEach(([name, unit, least], k) => {
      const y0 = (k * h) / STRIPS.length + 3 * scale, y1 = ((k + 1) * h) / STRIPS.length - 3 * scale;
      let values = shown.map((l) => l.nav[name]);
      if (name === "heading") values = unwrap(values);
      let low = Math.min(...values), high = Math.max(...values);
      const middle = (low + high) / 2, half = Math.max(least / 2, (high - low) * 0.6);
      [low, high] = [middle - half, middle + half];
      const X = (t) => right - ((last.t - t) / SHOWN_S) * (right - left);
      const Y = (v) => y1 - ((v - low) / (high - low)) * (y1 - y0);
      g.strokeStyle = ink("line");
      g.fillStyle = ink("soft");
      g.lineWidth = scale;
      g.textAlign = "right";
      const step = stepOf(high - low, 2.2);
      for (let v = Math.ceil(low / step) * step; v <= high; v += step) {
        line(g, left, Y(v), right, Y(v));
        g.fillText(digits(name === "heading" ? ((v % 360) + 360) % 360 : v, step < 1 ? 1 : 0), left - 4 * scale, Y(v));
      }
      g.strokeStyle = ink("accent");
      g.lineWidth = 1.5 * scale;
      g.beginPath();
      shown.forEach((l, i) => {
        const gap = i > 0 && l.t - shown[i - 1].t > 5;
        g[i === 0 || gap ? "moveTo" : "lineTo"](X(l.t), Y(values[i]));
      });
      g.stroke();
      g.textAlign = "left";
      g.fillStyle = ink("ink");
      g.fillText(`${digits(last.nav[name], name === "heading" ? 1 : 2)}${unit === "m" ? " m" : unit}`, right + 5 * scale, (y0 + y1) / 2 - 6 * scale);
      g.fillStyle = ink("soft");
      g.fillText(name, right + 5 * scale, (y0 + y1) / 2 + 8 * scale);
    });
  }
}

const age = (s) => (s <= 0 ? "interpolated" : `${digits(s * 1e3, 0)} ms old`);

function unwrap(values) {
  let turn = 0;
  return values.map((v, k) => {
    if (k > 0) {
      if (v - values[k - 1] > 180) turn -= 360;
      else if (v - values[k - 1] < -180) turn += 360;
    }
    return v + turn;
  });
}
