// The sound-speed profile of a rig that has one: its points, as lines of depth and speed.
import { byId, say } from "./lib.js";

/** Depth and speed of a line; null where it does not begin with two numbers. */
function pointOf(line) {
  const [depth, speed] = line.trim().split(/[\s,;]+/);
  if (!depth || !speed) return null;
  const point = [Number(depth), Number(speed)];
  return point.every(Number.isFinite) ? point : null;
}

/** Points of a text. Lines before the first point are its head. Throws the first line that is no point. */
function pointsOf(text) {
  const points = [];
  for (const [k, line] of text.split(/\r?\n/).entries()) {
    if (!line.trim()) continue;
    const point = pointOf(line);
    if (point) points.push(point);
    else if (points.length > 0) throw new Error(`line ${k + 1}: expected a depth in m and a sound speed in m/s`);
  }
  return points;
}

export class Profile {
  constructor(ask) {
    this.ask = ask;
    this.text = byId("profile-points");
    byId("profile-set").addEventListener("click", () => this.#set());
    byId("profile-file").addEventListener("change", (e) => this.#read(e.target));
  }

  /** The rig. */
  rig(hello) {
    byId("profile").hidden = !hello.profile;
    if (hello.profile) this.#show(hello.profile);
  }

  #show(points) {
    this.text.value = points.map(([depth, speed]) => `${depth} ${speed}`).join("\n");
    this.#say(points);
  }

  #say(points) {
    const speeds = points.map(([, speed]) => speed);
    say(byId("profile-now"), `${points.length} points, ${Math.min(...speeds)} to ${Math.max(...speeds)} m/s`);
  }

  #note(text, bad) {
    const note = byId("profile-note");
    say(note, text);
    note.dataset.is = bad ? "bad" : "";
  }

  async #read(input) {
    const [file] = input.files;
    input.value = "";
    if (!file) return;
    try {
      const points = pointsOf(await file.text());
      if (points.length === 0) throw new Error("no line with a depth and a sound speed");
      this.text.value = points.map((point) => point.join(" ")).join("\n");
      this.#note(`${file.name}: ${points.length} points, not set yet`);
    } catch (error) {
      this.#note(`${file.name}: ${error.message}`, true);
    }
  }

  async #set() {
    try {
      const points = pointsOf(this.text.value);
      const answer = await this.ask({ do: "profile", points });
      if (answer.accepted) this.#say(points);
      this.#note(answer.accepted ? "set" : answer.why, !answer.accepted);
    } catch (error) {
      this.#note(error.message, true);
    }
  }
}
