// How punctual the daemon is, how its pings are made, who gets them.
import { byId, bytes, digits, make, microseconds } from "./lib.js";

const SPREADS = [
  ["compute_margin", "Margin: computed before due"],
  ["start_error", "Lateness: due until delivery began"],
  ["nav_to_samples", "Pulse until computed"],
  ["hand_over", "Due until delivery ended"],
  ["send_pacing", "Lateness of datagrams"],
];

export class Health {
  constructor() {
    this.model = null;
  }

  add(frame) {
    this.model = frame.model;
  }

  show(state, sonar) {
    if (byId("pane-health").hidden) return;
    const s = state.sonars[sonar];
    // A way of sending that is not used has nothing to show.
    const spreads = SPREADS.filter(([name]) => s.bins[name]?.length > 0 || name !== "send_pacing").map(([name, title]) => spread(title, s.microseconds[name], s.bins[name]));
    byId("health").replaceChildren(make("div", { class: "figures" }, ...spreads), make("div", { class: "figures" }, this.#counts(s, state), this.#plan(s)), clients(s, state));
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

function clients(s, state) {
  const rows = s.streams.map((c) => make("tr", {},
    make("th", { scope: "row" }, `${c.family} ${c.peer}`, c.receives ? make("small", { text: `  ${c.receives}` }) : null),
    make("td", { text: String(c.records_sent) }),
    make("td", { text: bytes(c.bytes_sent) }),
    make("td", { text: bytes(c.queued_bytes) }),
    make("td", { text: String(c.records_dropped), is: c.records_dropped > 0 ? "bad" : "good" })));
  if (!rows.length) rows.push(make("tr", {}, make("td", { colspan: 5, text: "no clients" })));
  const f = state.feed;
  rows.push(make("tr", {}, make("th", { scope: "row", text: `pages: ${f.pages} open, ${f.pages_ever} ever` }), make("td", { text: String(f.sent) }), make("td", { text: "" }), make("td", { text: "" }), make("td", { text: String(f.dropped), is: f.dropped > 0 ? "warn" : "good" })));
  const heads = ["Client", "Records", "Sent", "Waiting", "Lost"];
  const others = s.outputs.filter((text) => !text.startsWith("  "));
  return make("div", {}, make("table", {}, make("caption", { text: "Clients and their records" }), make("thead", {}, make("tr", {}, ...heads.map((text) => make("th", { scope: "col", text })))), make("tbody", {}, ...rows)),
    ...others.map((text) => make("p", { class: "line", text })));
}
