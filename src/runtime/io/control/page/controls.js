// What can be asked, what was accepted, and by whom.
import { byId, make, say, short, timeOf } from "./lib.js";

const SETTINGS = [
  ["range_m", "Range", "m"],
  ["source_level_db", "Source level", "dB"],
  ["gain_db", "Gain", "dB"],
  ["pulse_ms", "Pulse", "ms"],
  ["rate_hz", "Pings", "/s"],
];
const NAMES = Object.fromEntries(SETTINGS.map(([key, name, unit]) => [key, [name.toLowerCase(), unit]]));
const OF_ELEMENTS = new Set(["dead", "stuck", "inverted", "swapped", "gain", "phase", "clipping", "offset", "noise-burst", "mains-hum", "adc-bit-stuck-high", "adc-bit-stuck-low", "crosstalk", "clock-drift", "sample-slip"]);
const OF_TWO = new Set(["swapped", "crosstalk"]);

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
    byId("fault-kind").addEventListener("change", () => this.#shape());
    byId("faults-clear").addEventListener("click", () => this.ask({ do: "clear-faults" }));
    byId("fault-form").addEventListener("submit", (e) => {
      e.preventDefault();
      this.#inject(new FormData(e.target));
    });
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
    const kind = byId("fault-kind");
    const was = kind.value;
    kind.replaceChildren(...hello.faults.map((f) => make("option", { value: f.kind, text: f.kind })));
    if (was) kind.value = was;
    const arrays = hello.sonars[index].arrays.map((a, k) => make("option", { value: k, text: a.name }));
    byId("fault-form").elements.array.replaceChildren(make("option", { value: "", text: "all" }), ...arrays);
    this.#shape();
  }

  #shape() {
    const fault = this.hello.faults.find((f) => f.kind === byId("fault-kind").value);
    const form = byId("fault-form");
    say(byId("fault-unit"), fault.unit ? `Value, ${fault.unit}` : "No value");
    const { value } = form.elements;
    value.disabled = !fault.unit;
    value.required = Boolean(fault.unit);
    value.placeholder = fault.unit ? `${short(fault.min)} to ${short(fault.max)}` : "";
    for (const label of form.querySelectorAll("[data-of]")) {
      const fits = label.dataset.of === "two" ? OF_TWO.has(fault.kind) : OF_ELEMENTS.has(fault.kind);
      label.querySelector("input, select").disabled = !fits;
    }
  }

  #inject(data) {
    const command = { do: "fault", sonar: this.name };
    for (const [key, text] of data) {
      if (text === "") continue;
      command[key] = key === "kind" ? text : Number(text);
    }
    this.ask(command);
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
      say(note, last ? `${last.why ? "refused" : "accepted"} ${timeOf(last.utc_ms, 0)}, requested ${short(last.value)} by ${who(last)}` : "as configured");
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
    this.#faults(state);
    this.#log(state);
  }

  #faults(state) {
    say(byId("faults-count"), state.faults.length ? `${state.faults.length} active, ${state.faults_injected} injected` : "none");
    byId("faults-clear").disabled = state.faults.length === 0;
    const key = JSON.stringify(state.faults.map((f) => [f.fault, f.injected]));
    const list = byId("faults");
    if (this.faultsKey !== key || state.faults.some((f) => f.for_s)) {
      this.faultsKey = key;
      const kept = new Map([...list.children].map((li) => [li.dataset.fault, li]));
      list.replaceChildren(...state.faults.map((f) => this.#fault(f, state, kept.get(String(f.fault)))));
    }
  }

  #fault(f, state, kept) {
    const item = kept ?? make("li", { "data-fault": f.fault }, make("span", { class: "name" }), make("span", { class: "when" }), make("button", { type: "button", text: "×", "aria-label": `Remove fault ${f.fault}`, onclick: () => this.ask({ do: "clear-faults", fault: f.fault }) }), make("progress", { max: 1, value: 0, "aria-label": "Progress" }));
    const [name, when, , progress] = item.children;
    say(name, faultInWords(f, this.hello.sonars[this.index]));
    const [words, share, isActive] = timeline(f, state.rig_utc_ms);
    say(when, `${words}, injected ${f.injected}`);
    name.dataset.is = isActive ? "good" : "";
    progress.value = share;
    progress.hidden = !f.for_s;
    return item;
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
  const more = Object.entries(rest).map(([key, value]) => `${key} ${typeof value === "number" ? short(value) : value}`);
  return [what, ...more].join(" ");
}

function faultInWords(f, sonar) {
  const where = [];
  if (f.array !== undefined) where.push(sonar.arrays[f.array]?.name ?? f.array);
  if (f.element !== undefined) where.push(f.element);
  if (f.other !== undefined) where.push(`and ${f.other}`);
  const value = f.value === undefined ? "" : ` ${short(f.value)}`;
  return `${f.fault} ${f.kind}${value}${where.length ? ` at ${where.join(" ")}` : ""}`;
}

/** Where a fault is in its time: words, share gone, whether it is active now. */
function timeline(f, now) {
  if (f.from_utc_ns === null) return ["waiting for a ping", 0, false];
  const age = now / 1e3 - f.from_utc_ns / 1e9;
  if (age < 0) return [`in ${Math.ceil(-age)} s`, 0, false];
  if (f.for_s === undefined) return ["active", 0, true];
  if (age >= f.for_s) return ["over", 1, false];
  return [`${Math.ceil(f.for_s - age)} s left`, age / f.for_s, true];
}

export const ofElements = (fault) => ({ ...fault, isOfElement: OF_ELEMENTS.has(fault.kind) });
