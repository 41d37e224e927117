// How punctual the daemon is, how its pings are made, who gets them.
import { byId, bytes, digits, make, microseconds } from "./lib.js";

const SPREADS = [
  ["compute_margin", "Margin: computed before due"],
  ["start_error", "Lateness: due until delivery began"],
  ["nav_to_samples", "Pulse until computed"],
  ["hand_over", "Due until delivery ended"],
  ["send_pacing", "Lateness of datagrams"],
];

/** States over which the rates of clients are taken: about five seconds. */
const RATE_STATES = 10;

export class Health {
  constructor() {
    this.model = null;
    this.rates = new Map();
  }

  add(frame) {
    this.model = frame.model;
  }

  show(hello, state, sonar, checks) {
    if (byId("pane-health").hidden) return;
    const s = state.sonars[sonar];
    // A way of sending that is not used has nothing to show.
    const spreads = SPREADS.filter(([name]) => s.bins[name]?.length > 0 || name !== "send_pacing").map(([name, title]) => spread(title, s.microseconds[name], s.bins[name]));
    byId("health").replaceChildren(
      verdict(checks),
      ports(hello),
      this.#clients(s, state),
      make("div", { class: "figures" }, this.#counts(s, state), this.#plan(s)),
      make("div", { class: "figures" }, ...spreads));
  }

  get isEmpty() {
    return true;
  }

  /** Records and bytes a second of a client, from the states of the last seconds. */
  #rate(client, up) {
    const key = `${client.family} ${client.peer}`;
    const marks = this.rates.get(key) ?? [];
    this.rates.set(key, marks);
    if (marks.at(-1)?.up !== up) marks.push({ up, records: client.records_sent, bytes: client.bytes_sent });
    if (marks.length > RATE_STATES) marks.shift();
    const [first, last] = [marks[0], marks.at(-1)];
    const seconds = last.up - first.up;
    return seconds > 0 ? [(last.records - first.records) / seconds, (last.bytes - first.bytes) / seconds] : [NaN, NaN];
  }

  #clients(s, state) {
    const rows = s.streams.map((c) => {
      const [records, rate] = this.#rate(c, state.up_s);
      return make("tr", {},
        make("th", { scope: "row" }, `${c.family} ${c.peer}`, c.receives ? make("small", { text: `gets records ${c.receives}` }) : null),
        make("td", { text: `${digits(records, 1)} /s` }),
        make("td", { text: Number.isFinite(rate) ? `${bytes(Math.round(rate))}/s` : "–" }),
        make("td", { text: bytes(c.queued_bytes) }),
        make("td", { text: String(c.records_dropped), is: c.records_dropped > 0 ? "bad" : "good" }));
    });
    if (!rows.length) rows.push(make("tr", {}, make("td", { colspan: 5, text: "no clients" })));
    const f = state.feed;
    rows.push(make("tr", {}, make("th", { scope: "row", text: `pages: ${f.pages} open` }), make("td", { text: "" }), make("td", { text: "" }), make("td", { text: "" }), make("td", { text: String(f.dropped), is: f.dropped > 0 ? "warn" : "good" })));
    const heads = ["Client", "Records", "Data", "Waiting", "Lost"];
    const others = s.outputs.filter((text) => !text.startsWith("  "));
    return make("div", {}, table("Clients", heads, rows), ...others.map((text) => make("p", { class: "line", text })));
  }

  #counts(s, state) {
    const c = s.counters;
    return facts([
      ["Pings made", c.pings_made],
      ["skipped: navigation", c.pings_skipped_nav],
      ["skipped: late", c.pings_skipped_late],
      ["skipped: queue full", c.pings_skipped_queue],
      ["Deadline misses", c.deadline_misses],
      ["Greatest lateness", microseconds(c.worst_late_us)],
      ["Triggers missed", c.triggers_missed],
      ["Faults injected", state.faults_injected],
      ["Saturated values", c.samples_saturated],
      ["Navigation age", `${c.nav_age_ms} ms`],
    ]);
  }

  #plan(s) {
    const m = this.model;
    const c = s.counters;
    const mean = c.pings_made ? c.compute_us / c.pings_made : 0;
    const rows = [["Compute, mean", microseconds(Math.round(mean))], ["Compute, worst", microseconds(c.worst_compute_us)]];
    if (m) {
      rows.push(["Path", `${m.path}, ${digits(m.segment_ms, 0)} ms`], ["Doppler", m.doppler], ["Synthesis", m.synthesis]);
      rows.push(["Culling", m.cull_db === null ? "none" : `${m.cull_db} dB`], ["Scatterers", m.scatterers.toLocaleString("en")], ["In shadow", m.shadowed.toLocaleString("en")]);
      const cert = m.error_check;
      rows.push(["Error check", cert ? `${cert.error.toExponential(1)} of ${cert.tolerance.toExponential(0)}` : "off"]);
      const plan = s.methods;
      rows.push(["Selected methods", plan ? `no. ${plan.plan}: ${plan.predicted_error.toExponential(1)} of ${plan.tolerance.toExponential(0)} predicted` : "none: as configured"]);
      if (cert) rows.push(["95 % interval", `${cert.low.toExponential(1)} to ${cert.high.toExponential(1)}${cert.fault ? ", FAULT" : ""}`]);
    }
    return facts(rows);
  }
}

function facts(rows) {
  return make("dl", { class: "kv" }, ...rows.flatMap(([name, value]) => [make("dt", { text: name }), make("dd", { text: String(value) })]));
}

function spread(title, figures, bins) {
  const most = Math.max(1, ...bins.map(([, n]) => n));
  const bars = bins.map(([end, n]) => {
    // Seldom is not never: a bar's height is the logarithm of its count.
    const bar = make("i", { title: `up to ${microseconds(end)}: ${n}`, is: n === 0 ? "none" : null });
    bar.style.height = n === 0 ? "1px" : `${6 + 94 * (Math.log1p(n) / Math.log1p(most))}%`;
    return bar;
  });
  const words = `p50 ${microseconds(figures.p50_us)}, p99 ${microseconds(figures.p99_us)}, max ${microseconds(figures.max_us)}, min ${microseconds(figures.min_us)}`;
  return make("figure", { style: null, "aria-label": `${title}: ${words}` },
    make("div", { class: "bins", role: "img", "aria-hidden": "true" }, ...bars),
    make("div", { class: "bins-scale" }, make("span", { text: bins.length ? `≤ ${microseconds(bins[0][0])}` : "" }), make("span", { text: bins.length ? microseconds(bins.at(-1)[0]) : "" })),
    make("figcaption", {}, make("strong", { text: title }), make("span", { text: words })));
}

function table(caption, heads, rows) {
  return make("table", {}, make("caption", { text: caption }), make("thead", {}, make("tr", {}, ...heads.map((text) => make("th", { scope: "col", text })))), make("tbody", {}, ...rows));
}

function verdict(checks) {
  const rows = checks.map((c) => make("li", { is: c.is }, make("strong", { text: c.name }), make("span", { text: c.text })));
  return make("ul", { class: "checks", "aria-label": "Verdict" }, ...rows);
}

/** Where programs can connect, or where data goes: the protocol, the name, how, and the address. */
function ports(hello) {
  const parts = hello.ports.map((text) => text.match(/^(.+?) (tcp|udp|serial|tcp-listen|file)( .*)?$/) ?? [text, text, "", ""]);
  const rows = parts.filter(([, , how]) => how !== "file").map(([, what, how, at]) => make("tr", {}, make("th", { scope: "row", text: what }), make("td", { text: how }), make("td", { class: "at", text: (at ?? "").trim() })));
  if (!rows.length) rows.push(make("tr", {}, make("td", { colspan: 3, text: "no output of this rig has an address" })));
  return table("Ports", ["Protocol and sonar", "Transport", "Address"], rows);
}
