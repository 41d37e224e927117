// What can be asked, what was accepted, and by whom.
import { byId, bytes, make, say, short, timeOf } from "./lib.js";

const SETTINGS = [
  ["range_m", "Range", "m"],
  ["source_level_db", "Source level", "dB"],
  ["gain_db", "Gain", "dB"],
  ["pulse_ms", "Pulse", "ms"],
  ["rate_hz", "Pings", "/s"],
];
const NAMES = Object.fromEntries(SETTINGS.map(([key, name, unit]) => [key, [name.toLowerCase(), unit]]));

export class Controls {
  constructor(link) {
    this.link = link;
    this.rows = new Map();
    this.refused = [];
    this.build();
  }

  build() {
    for (const [key, name, unit] of SETTINGS) {
      const input = make("input", { type: "number", step: "any", id: `set-${key}`, "aria-describedby": `note-${key}` });
      const now = make("span", { class: "now", id: `now-${key}`, text: "–" });
      const note = make("span", { class: "note", id: `note-${key}` });
      const set = make("button", { type: "button", text: "Set", "aria-label": `Set ${name.toLowerCase()}` });
      const row = make("div", { class: "setting" }, make("label", { for: input.id, text: name }), now, input, set, note);
      const ask = () => {
        if (input.value === "") return;
        this.ask({ do: "set", [key]: Number(input.value) }, note);
        input.value = "";
      };
      set.addEventListener("click", ask);
      input.addEventListener("keydown", (e) => e.key === "Enter" && ask());
      this.rows.set(key, { row, input, now, note, unit });
      byId("settings").append(row);
    }
    byId("start").addEventListener("click", () => this.ask({ do: "set", pinging: !this.pinging }));
    byId("single").addEventListener("click", () => this.single());
    byId("pause").addEventListener("click", () => this.pause());
    byId("step").addEventListener("click", () => this.step());
    byId("trigger").addEventListener("change", (e) => this.ask({ do: "set", trigger: e.target.value }));
    const clock = () => {
      const mode = byId("clock-mode").value;
      this.ask(mode === "scaled" ? { do: "clock", mode, rate: Number(byId("clock-rate").value) } : { do: "clock", mode });
    };
    byId("clock-mode").addEventListener("change", () => {
      byId("clock-rate-label").hidden = byId("clock-mode").value !== "scaled";
      if (byId("clock-mode").value === "scaled" && byId("clock-rate").value === "1") byId("clock-rate").value = "2";
      clock();
    });
    byId("clock-rate").addEventListener("change", clock);
    byId("record").addEventListener("click", () => this.ask({ do: "record", on: !this.recording }));
  }

  /** The rig, and which of its sonars is looked at. */
  sonar(hello, index) {
    this.hello = hello;
    this.index = index;
    this.name = hello.sonars[index].name;
    for (const [key, { input }] of this.rows) {
      const [least, most] = hello.sonars[index].limits[key];
      input.placeholder = `${short(least)}–${short(most)}`;
      input.title = `from ${short(least)} to ${short(most)}`;
    }
  }

  /** Asks; a refusal is told beside what was asked for. */
  async ask(command, note = null) {
    if (command.do === "set" || command.do === "trigger") command.sonar = this.name;
    const answer = await this.link.command(command);
    if (!answer.accepted) {
      if (note) {
        say(note, answer.why);
        note.dataset.is = "bad";
        this.refused.push([note, Date.now() + 8000]);
      }
      // What never reached the daemon is in nobody's journal.
      if (!answer.asked) this.lost(command, answer.why);
    }
    return answer;
  }

  lost(command, why) {
    byId("log").prepend(make("li", {}, make("time", { text: "" }), make("span", {}, make("span", { class: "what", text: `${inWords(command)} ` }), make("span", { class: "why", text: why }))));
  }

  pause() {
    return this.ask({ do: this.paused ? "resume" : "pause" });
  }
  step() {
    return this.ask({ do: "step" });
  }
  single() {
    return this.ask({ do: "trigger", pings: 1 });
  }
  range(by) {
    return this.ask({ do: "set", range_m: Number((this.settings.range_m * by).toPrecision(3)) }, this.rows.get("range_m").note);
  }

  show(state) {
    const s = state.sonars[this.index];
    this.settings = s.settings;
    this.pinging = s.settings.pinging;
    this.paused = state.paused;
    const late = Date.now();
    this.refused = this.refused.filter(([, until]) => until > late);
    for (const [key, { row, now, note, unit }] of this.rows) {
      say(now, `${short(s.settings[key])} ${unit}`);
      const last = s.journal.findLast((c) => c.what === key && !c.kept);
      if (this.refused.some(([held]) => held === note)) continue;
      say(note, last ? `${last.why ? "refused" : "accepted"} ${timeOf(last.utc_ms, 0)}, requested ${short(last.value)} by ${who(last)}` : "");
      note.dataset.is = last?.why ? "bad" : "";
      row.toggleAttribute("data-fresh", Boolean(last && !last.why && state.rig_utc_ms - last.utc_ms < 3000));
    }
    say(byId("start"), this.pinging ? "Stop" : "Start");
    say(byId("pause"), state.paused ? "Resume" : "Pause");
    byId("pause").setAttribute("aria-pressed", String(state.paused));
    if (document.activeElement !== byId("trigger")) byId("trigger").value = s.trigger;
    if (document.activeElement !== byId("clock-mode")) {
      byId("clock-mode").value = state.clock;
      byId("clock-rate-label").hidden = state.clock !== "scaled";
    }
    const own = state.clock === "fast" || state.clock === "lockstep";
    for (const option of byId("clock-mode").options) option.disabled = !this.hello.recorded_nav || (option.value === "fast" || option.value === "lockstep") !== own;
    if (document.activeElement !== byId("clock-rate") && state.rate) byId("clock-rate").value = state.rate;
    this.#recordings(state);
    this.#log(state);
  }

  /** Of all sonars together: one button for all. */
  #recordings(state) {
    const files = state.sonars.flatMap((s) => Object.values(s.recording.files)).filter((f) => f.is_switched);
    const button = byId("record");
    this.recording = files.length > 0 && state.sonars.some((s) => s.recording.on && Object.values(s.recording.files).some((f) => f.is_switched));
    button.disabled = files.length === 0;
    button.title = files.length ? `Records go to ${this.hello.records_to}` : this.hello.records_to ? "No output of this rig records" : "The configuration has no folder of recordings: record.directory";
    button.setAttribute("aria-pressed", String(this.recording));
    say(button, this.recording ? "Stop recording" : "Record");
    const stopped = files.find((f) => f.stopped);
    const sum = files.filter((f) => f.is_open).reduce((sum, f) => sum + f.bytes, 0);
    say(byId("recording"), files.length === 0 ? "not configured" : !this.recording ? "off" : stopped ? "stopped by an error" : `on, ${bytes(sum)}`);
    byId("recording").dataset.is = stopped && this.recording ? "bad" : "";
  }

  #log(state) {
    const rows = [];
    for (const s of state.sonars) for (const c of s.journal) rows.push({ ...c, sonar: s.name, text: c.value === null ? c.what : `${(NAMES[c.what]?.[0] ?? c.what)} ${typeof c.value === "number" ? short(c.value) : JSON.stringify(c.value)} ${NAMES[c.what]?.[1] ?? ""}` });
    for (const d of state.commands) rows.push({ ...d, text: inWords(d.command) });
    rows.sort((a, b) => a.utc_ms - b.utc_ms);
    const newest = rows.slice(-80).reverse();
    const key = JSON.stringify(newest.map((r) => [r.utc_ms, r.text, r.via, r.why]));
    if (key === this.logKey) return;
    this.logKey = key;
    byId("log").replaceChildren(...newest.map((r) => make("li", {},
      make("time", { text: timeOf(r.utc_ms, 0) }),
      make("span", {},
        make("span", { class: "what", text: r.text.trim() }),
        make("span", { class: "by", text: ` ${r.why ? "refused" : r.kept ? "kept" : "accepted"}, by ${who(r)}` }),
        r.why ? make("span", { class: "why", text: ` ${r.why}` }) : null))));
  }
}

const who = (c) => `${c.via}${c.peer ? ` ${c.peer}` : ""}`;

function inWords(command) {
  const { do: what, ...rest } = command;
  if (what === "record") return `recording ${rest.on ? "on" : "off"}${rest.sonar ? ` for ${rest.sonar}` : ""}`;
  if (what === "profile") return `profile of ${rest.points.length} points`;
  const more = Object.entries(rest).map(([key, value]) => `${key} ${typeof value === "number" ? short(value) : value}`);
  return [what, ...more].join(" ");
}
