// What every part of the page uses: elements without markup, numbers in words, colours, canvases.

export const byId = (id) => document.getElementById(id);

/** An element of properties and children; text is only ever text. */
export function make(tag, props = {}, ...children) {
  const node = document.createElement(tag);
  for (const [key, value] of Object.entries(props)) {
    if (key.startsWith("on")) node.addEventListener(key.slice(2), value);
    else if (key === "text") node.textContent = value;
    else if (key === "is") node.dataset.is = value;
    else if (value === true) node.setAttribute(key, "");
    else if (value !== false && value !== null && value !== undefined) node.setAttribute(key, value);
  }
  node.append(...children.filter((c) => c !== null));
  return node;
}

/** Sets text only where it differs: no needless work for screen readers and layout. */
export function say(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

export const digits = (value, places) =>
  value === null || value === undefined || !Number.isFinite(value) ? "–" : value.toFixed(places);

/** As many digits as say something. */
export function short(value) {
  if (!Number.isFinite(value)) return "–";
  if (Number.isInteger(value)) return String(value);
  return String(Number(value.toPrecision(5)));
}

export function microseconds(us) {
  if (us < 1000) return `${us} µs`;
  if (us < 1e6) return `${(us / 1e3).toFixed(us < 1e4 ? 2 : 0)} ms`;
  return `${(us / 1e6).toFixed(2)} s`;
}

export function bytes(n) {
  if (n < 1e4) return `${n} B`;
  if (n < 1e7) return `${(n / 1e3).toFixed(0)} kB`;
  return `${(n / 1e6).toFixed(1)} MB`;
}

export function timeOf(ms, places = 1) {
  if (!Number.isFinite(ms)) return "–";
  const text = new Date(ms).toISOString();
  return text.slice(11, 20 + places).replace(/\.$/, "").replace("Z", "");
}

export function degrees(value, positive, negative, places = 5) {
  return `${Math.abs(value).toFixed(places)}° ${value < 0 ? negative : positive}`;
}

/** Round steps for an axis: about `count` of them over `span`. */
export function stepOf(span, count) {
  const raw = span / Math.max(1, count);
  const ten = 10 ** Math.floor(Math.log10(raw));
  return [1, 2, 5, 10].map((k) => k * ten).find((k) => k >= raw * 0.999);
}

const MAPS = {
  copper: [[0, 0, 0], [92, 46, 8], [196, 124, 28], [255, 244, 200]],
  grey: [[0, 0, 0], [255, 255, 255]],
  blue: [[4, 8, 40], [16, 60, 150], [60, 190, 220], [255, 255, 255]],
  viridis: [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]],
  rainbow: [[24, 16, 120], [0, 110, 230], [0, 180, 90], [250, 230, 30], [210, 20, 20]],
};
export const mapNames = Object.keys(MAPS);

/** 256 colours as the four bytes of a pixel. */
export function palette(name) {
  const stops = MAPS[name] ?? MAPS.copper;
  const out = new Uint32Array(256);
  for (let k = 0; k < 256; k++) {
    const x = (k / 255) * (stops.length - 1);
    const i = Math.min(Math.floor(x), stops.length - 2);
    const [r, g, b] = stops[i].map((c, j) => Math.round(c + (stops[i + 1][j] - c) * (x - i)));
    out[k] = (255 << 24) | (b << 16) | (g << 8) | r;
  }
  return out;
}

/** Colour of each level of a frame (0: nothing) between two levels in dB. */
export function lookup(colours, lowDb, stepDb, fromDb, toDb) {
  const out = new Uint32Array(256);
  out[0] = colours[0];
  for (let v = 1; v < 256; v++) {
    const share = (lowDb + v * stepDb - fromDb) / Math.max(1e-6, toDb - fromDb);
    out[v] = colours[Math.max(0, Math.min(255, Math.round(share * 255)))];
  }
  return out;
}

/** Where most of the levels lie, by a histogram that forgets. */
export class Contrast {
  constructor() {
    this.bins = new Float64Array(2400); // -600 dB to 600 dB in halves
  }
  add(levels, lowDb, stepDb) {
    for (let k = 0; k < this.bins.length; k++) this.bins[k] *= 0.98;
    for (const v of levels) {
      if (v === 0) continue;
      const bin = Math.round((lowDb + v * stepDb + 600) * 2);
      if (bin >= 0 && bin < this.bins.length) this.bins[bin] += 1;
    }
  }
  span(low = 0.36, high = 0.9995, least = 24) {
    let sum = 0;
    for (const n of this.bins) sum += n;
    if (sum === 0) return [-60, 0];
    const at = (share) => {
      let below = 0;
      for (let k = 0; k < this.bins.length; k++) {
        below += this.bins[k];
        if (below >= share * sum) return k / 2 - 600;
      }
      return 0;
    };
    const [a, b] = [at(low), at(high)];
    return b - a < least ? [b - least, b + 3] : [a, b + 3];
  }
}

/** A canvas as large as the screen shows it; false while it is not shown. */
export function fit(canvas) {
  const scale = window.devicePixelRatio || 1;
  const box = canvas.getBoundingClientRect();
  const width = Math.round(box.width * scale);
  const height = Math.round(box.height * scale);
  if (width < 8 || height < 8) return false;
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
  canvas.scale = scale;
  return true;
}

/** A colour of the sheet. */
export const ink = (name) => {
  probe.style.color = `var(--${name})`;
  return getComputedStyle(probe).color;
};
const probe = document.createElement("span");
probe.hidden = true;
document.documentElement.append(probe);

/** Draws at most once a frame, and not at all while nobody sees it. */
export function painter(canvas, draw) {
  let asked = false;
  const paint = () => {
    asked = false;
    if (canvas.offsetParent !== null && fit(canvas)) draw(canvas.getContext("2d"), canvas.width, canvas.height, canvas.scale);
  };
  const ask = () => {
    if (!asked) {
      asked = true;
      requestAnimationFrame(paint);
    }
  };
  new ResizeObserver(ask).observe(canvas);
  document.addEventListener("themechange", ask);
  return ask;
}

/** Where a pointer is, in the canvas's own pixels. */
export function pointer(canvas, event) {
  const box = canvas.getBoundingClientRect();
  const scale = canvas.width / box.width;
  return [(event.clientX - box.left) * scale, (event.clientY - box.top) * scale];
}

/** Axes of a plot: frame, ticks, names. Returns the two scales. */
export function axes(g, w, h, scale, x, y) {
  const left = 46 * scale, right = w - 8 * scale, top = 8 * scale, bottom = h - 24 * scale;
  const px = (v) => left + ((v - x.from) / (x.to - x.from || 1)) * (right - left);
  const py = (v) => bottom - ((v - y.from) / (y.to - y.from || 1)) * (bottom - top);
  g.font = `${10.5 * scale}px system-ui, sans-serif`;
  g.lineWidth = scale;
  g.strokeStyle = ink("line");
  g.fillStyle = ink("soft");
  const ticks = (axis, count, each) => {
    const step = stepOf(axis.to - axis.from || 1, count);
    for (let v = Math.ceil(axis.from / step - 1e-9) * step; v <= axis.to + 1e-9 * step; v += step) each(Math.abs(v) < step * 1e-6 ? 0 : v);
  };
  g.textAlign = "center";
  g.textBaseline = "top";
  ticks(x, (right - left) / (70 * scale), (v) => {
    line(g, px(v), top, px(v), bottom);
    g.fillText(short(v), px(v), bottom + 3 * scale);
  });
  g.textAlign = "right";
  g.textBaseline = "middle";
  ticks(y, (bottom - top) / (30 * scale), (v) => {
    line(g, left, py(v), right, py(v));
    g.fillText(short(v), left - 4 * scale, py(v));
  });
  g.textBaseline = "alphabetic";
  g.fillText(x.name, right, h - 2 * scale);
  g.textAlign = "left";
  g.fillText(y.name, 2 * scale, h - 2 * scale);
  return { px, py, left, right, top, bottom };
}

export function line(g, x0, y0, x1, y1) {
  g.beginPath();
  g.moveTo(x0, y0);
  g.lineTo(x1, y1);
  g.stroke();
}
