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

/** A time for a file name: 20140801T000049. */
export const stampOf = (ms) => new Date(ms).toISOString().slice(0, 19).replace(/[-:]/g, "");

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

/** Half decibels from -600 dB to 600 dB. */
const BINS = 2400;
/** Fewer samples of the seabed say nothing about its levels. */
const ENOUGH = 200;

/** Where most of the levels lie, by histograms that forget. Levels of the seabed count as soon as there are any; else all do. */
export class Contrast {
  constructor() {
    this.all = new Float64Array(BINS);
    this.seabed = new Float64Array(BINS);
    this.count = 0;
  }
  /** Rows of one ping: levels, and the index of the first that belongs to the seabed. */
  add(rows, lowDb, stepDb) {
    const hasSeabed = rows.some(([levels, seabed]) => seabed < levels.length);
    for (let k = 0; k < BINS; k++) {
      this.all[k] *= 0.98;
      // Levels of the seabed outlast pings that do not reach it.
      if (hasSeabed) this.seabed[k] *= 0.98;
    }
    if (hasSeabed) this.count *= 0.98;
    for (const [levels, seabed] of rows) {
      for (let k = 0; k < levels.length; k++) {
        if (levels[k] === 0) continue;
        const bin = Math.round((lowDb + levels[k] * stepDb + 600) * 2);
        if (bin < 0 || bin >= BINS) continue;
        this.all[bin] += 1;
        if (k < seabed) continue;
        this.seabed[bin] += 1;
        this.count += 1;
      }
    }
  }
  /** Levels in dB between two shares of the samples, with at least `least` dB between them. */
  span([low, high], ofAll = [low, high], least = 15) {
    const [bins, shares] = this.count >= ENOUGH ? [this.seabed, [low, high]] : [this.all, ofAll];
    const sum = bins.reduce((a, n) => a + n, 0);
    if (sum === 0) return [-60, 0];
    const at = (share) => {
      let below = 0;
      for (let k = 0; k < BINS; k++) {
        below += bins[k];
        if (below >= share * sum) return k / 2 - 600;
      }
      return 0;
    };
    const [a, b] = shares.map(at);
    return b - a < least ? [b - least, b + 1] : [a, b + 1];
  }
}

/** A colour bar with its scale: the first colour belongs to `from`, at the bottom. */
export function colourBar(g, box, scale, colours, from, to, unit) {
  const { x, y, height } = box;
  const width = 10 * scale;
  const image = g.createImageData(Math.round(width), Math.round(height));
  const pixels = new Uint32Array(image.data.buffer);
  for (let row = 0; row < image.height; row++) {
    const colour = colours[Math.round(255 * (1 - row / Math.max(1, image.height - 1)))];
    pixels.fill(colour, row * image.width, (row + 1) * image.width);
  }
  g.putImageData(image, Math.round(x), Math.round(y));
  g.font = `${10.5 * scale}px system-ui, sans-serif`;
  g.fillStyle = g.strokeStyle = ink("soft");
  g.lineWidth = scale;
  g.textAlign = "left";
  g.textBaseline = "middle";
  const [low, high] = [Math.min(from, to), Math.max(from, to)];
  const step = stepOf(high - low || 1, height / (34 * scale));
  const at = (v) => y + height - ((v - from) / (to - from || 1)) * height;
  for (let v = Math.ceil(low / step - 1e-9) * step; v <= high + 1e-9 * step; v += step) {
    line(g, x + width, at(v), x + width + 3 * scale, at(v));
    const inside = Math.max(y + 5 * scale, Math.min(y + height - 5 * scale, at(v)));
    g.fillText(short(Math.abs(v) < step * 1e-6 ? 0 : v), x + width + 5 * scale, inside);
  }
  g.textBaseline = "bottom";
  g.fillText(unit, x, y - 3 * scale);
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

/** Keeps the pointer's place on the canvas of a view as `view.at`, null beside it, and calls `react` after each change. */
export function followPointer(view, react) {
  view.canvas.addEventListener("pointermove", (e) => {
    view.at = pointer(view.canvas, e);
    react();
  });
  view.canvas.addEventListener("pointerleave", () => {
    view.at = null;
    react();
  });
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
