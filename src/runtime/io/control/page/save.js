// Pictures and data of the views as files.
import { ink } from "./lib.js";

function download(name, blob) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  // The browser has read the address by then.
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

/** Lines of comma-separated values; the first lines, with #, say what they are. */
export function saveData(name, about, columns, rows) {
  const lines = [...about.map((text) => `# ${text}`), columns.join(","), ...rows.map((row) => row.join(","))];
  download(name, new Blob([lines.join("\n"), "\n"], { type: "text/csv" }));
}

/** The canvases of a view as one picture, where they lie in it, under a title. */
export function savePicture(name, title, view, canvases) {
  const scale = window.devicePixelRatio || 1;
  const box = view.getBoundingClientRect();
  const head = 22 * scale;
  const picture = document.createElement("canvas");
  picture.width = Math.round(box.width * scale);
  picture.height = Math.round(box.height * scale + head);
  const g = picture.getContext("2d");
  g.fillStyle = ink("panel");
  g.fillRect(0, 0, picture.width, picture.height);
  g.fillStyle = ink("ink");
  g.font = `600 ${12 * scale}px system-ui, sans-serif`;
  g.textBaseline = "middle";
  g.fillText(title, 8 * scale, head / 2);
  for (const canvas of canvases) {
    const at = canvas.getBoundingClientRect();
    if (canvas.width > 0) g.drawImage(canvas, (at.left - box.left) * scale, (at.top - box.top) * scale + head);
  }
  picture.toBlob((blob) => download(name, blob), "image/png");
}
