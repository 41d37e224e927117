// Whether the rig runs as it should: one check after the other, each good, warn or bad with its reason.
import { bytes, digits, microseconds } from "./lib.js";

/** Counts are those of the last minute. */
const WINDOW_S = 60;
/** A sonar that pings is silent after this many periods and seconds. */
const SILENT_PERIODS = 5;
const SILENT_S = 5;
const RANK = { good: 0, warn: 1, bad: 2 };
const COUNTED = {
  late: "deadline_misses",
  skippedLate: "pings_skipped_late",
  skippedNav: "pings_skipped_nav",
  skippedQueue: "pings_skipped_queue",
  truncated: "pings_truncated",
  stretched: "pings_stretched",
  degraded: "pings_degraded",
  error: "error_check_faults",
};

const plural = (n, one) => `${n} ${one}${n === 1 ? "" : "s"}`;

export class Verdict {
  constructor() {
    this.clear();
  }

  /** Another run of the daemon. */
  clear() {
    this.marks = [];
    this.lost = new Map(); // of each client: records lost so far
    this.lostNow = [];
    this.made = new Map(); // of each sonar: number of pings, and since when
    this.gave = new Map(); // of each source: the quantities that it once gave
    this.checks = [];
  }

  /** A state of the daemon; returns the worst of the checks. */
  take(state) {
    const now = state.up_s;
    const counts = {};
    for (const [name, key] of Object.entries(COUNTED)) counts[name] = state.sonars.reduce((sum, s) => sum + s.counters[key], 0);
    this.#clients(state, now);
    this.marks.push({ now, counts });
    while (this.marks.length > 2 && this.marks[1].now < now - WINDOW_S) this.marks.shift();
    const of = (name) => counts[name] - this.marks[0].counts[name];
    this.checks = [
      this.#pinging(state, now),
      late(of("late"), state),
      skipped(of),
      overload(of, state),
      ...this.#recordings(state),
      this.#navigation(state),
      this.#losses(),
      check("Error check", of("error") ? "bad" : "good", of("error") ? `${plural(of("error"), "ping")} above the tolerance of the methods in the last minute` : "samples within the tolerance"),
    ];
    return this.worst;
  }

  get worst() {
    const is = this.checks.reduce((worst, c) => (RANK[c.is] > RANK[worst] ? c.is : worst), "good");
    const found = this.checks.filter((c) => c.is !== "good").sort((a, b) => RANK[b.is] - RANK[a.is]);
    return { is, reasons: found.map((c) => c.text) };
  }

  #pinging(state, now) {
    const found = [];
    for (const s of state.sonars) {
      const made = s.counters.pings_made;
      const before = this.made.get(s.name);
      const waits = state.paused || !s.settings.pinging || s.trigger !== "internal";
      if (!before || before.made !== made || waits) this.made.set(s.name, { made, now });
      const silent = now - this.made.get(s.name).now;
      if (silent > SILENT_S + SILENT_PERIODS / Math.max(0.01, s.settings.rate_hz)) {
        const why = made === 0 ? `sonar ${s.name} waits for navigation: no ping yet` : `sonar ${s.name} has not pinged for ${Math.round(silent)} s`;
        found.push([made === 0 ? "warn" : "bad", why]);
      }
    }
    if (state.pipeline_problem) found.push(["bad", state.pipeline_problem]);
    return summary("Pings", found, `${state.sonars.reduce((sum, s) => sum + s.counters.pings_made, 0)} pings since the start`);
  }

  #recordings(state) {
    const checks = [];
    for (const s of state.sonars) {
      for (const [name, file] of Object.entries(s.recording.files)) {
        const of = `recording ${name}`;
        if (file.stopped) checks.push(check("Recording", "bad", `${of} stopped: ${file.stopped}`));
        else checks.push(check("Recording", "good", file.is_open ? `${of}: ${file.path}, ${bytes(file.bytes)}` : `${of} is off`));
      }
    }
    return checks;
  }

  #navigation(state) {
    const good = new Set(state.nav.filter((n) => n.state === "ok").map((n) => n.name));
    const found = [];
    for (const source of state.nav) {
      const gave = this.gave.get(source.name) ?? new Set();
      this.gave.set(source.name, gave);
      if (source.state === "ok") {
        for (const [quantity, owner] of Object.entries(state.nav_owners)) if (owner === source.name) gave.add(quantity);
        continue;
      }
      const uncovered = [...gave].filter((quantity) => !good.has(state.nav_owners[quantity]));
      if (source.state === "silent") found.push(["warn", `navigation source ${source.name} is silent`]);
      else if (source.state === "hold") found.push(["warn", `navigation source ${source.name} has not sent for a moment`]);
      else if (gave.size > 0 && uncovered.length === 0) found.push(["warn", `navigation source ${source.name} is ${source.state}; another source took over`]);
      else found.push(["bad", `navigation lost: source ${source.name} is ${source.state}${uncovered.length ? ` (${uncovered.join(", ")})` : ""}`]);
    }
    return summary("Navigation", found, `${plural(state.nav.length, "source")} in order`);
  }

  /** Records that clients lost since the last state. A client that goes takes its count along. */
  #clients(state, now) {
    const seen = new Map();
    for (const s of state.sonars) {
      for (const c of s.streams) {
        const key = `${s.name} ${c.family} ${c.peer}`;
        const before = this.lost.get(key) ?? 0;
        // The first state is where the counts begin.
        if (c.records_dropped > before && this.marks.length > 0) this.lostNow.push({ now, client: `${c.family} ${c.peer}`, n: c.records_dropped - before });
        seen.set(key, c.records_dropped);
      }
    }
    this.lost = seen;
    this.lostNow = this.lostNow.filter((l) => l.now > now - WINDOW_S);
  }

  #losses() {
    const sums = new Map();
    for (const { client, n } of this.lostNow) sums.set(client, (sums.get(client) ?? 0) + n);
    const found = [...sums].map(([client, n]) => ["warn", `client ${client} lost ${plural(n, "record")} in the last minute`]);
    return summary("Clients", found, `${plural(this.lost.size, "client")}, no record lost in the last minute`);
  }
}

const check = (name, is, text) => ({ name, is, text });

/** The worst of several findings, and all their texts. */
function summary(name, found, good) {
  if (found.length === 0) return check(name, "good", good);
  const is = found.some(([is]) => is === "bad") ? "bad" : "warn";
  return check(name, is, found.map(([, text]) => text).join("; "));
}

function late(n, state) {
  const worst = Math.max(...state.sonars.map((s) => s.counters.worst_late_us));
  const text = n ? `${plural(n, "ping")} late in the last minute, by up to ${microseconds(worst)}` : "no ping late in the last minute";
  return check("Punctuality", n ? "warn" : "good", text);
}

function skipped(of) {
  const parts = [[of("skippedLate"), "not computed in time"], [of("skippedNav"), "without navigation"], [of("skippedQueue"), "queue full"]].filter(([n]) => n > 0);
  const sum = parts.reduce((sum, [n]) => sum + n, 0);
  const text = sum ? `${plural(sum, "ping")} skipped in the last minute (${parts.map(([n, why]) => `${n} ${why}`).join(", ")})` : "no ping skipped in the last minute";
  return check("Skipped pings", sum ? "bad" : "good", text);
}

function overload(of, state) {
  const level = Math.max(...state.sonars.map((s) => s.counters.looser_now));
  const found = [];
  if (level > 0) found.push(["warn", `overload: pings are computed with a larger tolerance, level ${digits(level, 0)}`]);
  else if (of("degraded")) found.push(["warn", `overload: ${plural(of("degraded"), "ping")} computed with a larger tolerance in the last minute`]);
  if (of("truncated")) found.push(["warn", `overload: ${plural(of("truncated"), "ping")} truncated in the last minute`]);
  if (of("stretched")) found.push(["warn", `overload: ${plural(of("stretched"), "pulse")} delayed in the last minute`]);
  return summary("Overload", found, "none in the last minute");
}
