// The page put together: what comes over the link goes to its views.
import { byId, digits, make, mapNames, say, timeOf } from "./lib.js";
import { Link } from "./link.js";
import { Waterfall } from "./waterfall.js";
import { Fan } from "./fan.js";
import { Scope } from "./scope.js";
import { Elements } from "./elements.js";
import { Track } from "./track.js";
import { Motion } from "./motion.js";
import { Health } from "./health.js";
import { Controls, ofElements } from "./controls.js";

const link = new Link();
const waterfall = new Waterfall();
const fan = new Fan();
const scope = new Scope(look);
const elements = new Elements((array, element) => {
  show("tab-scope");
  byId("scope-of").value = "element";
  byId("scope-of").dispatchEvent(new Event("change"));
  byId("scope-array").value = array;
  byId("scope-index").value = element;
  look();
});
const track = new Track(link);
const motion = new Motion();
const health = new Health();
const controls = new Controls(link);

let hello = null;
let state = null;
let sonar = 0;

// ---- what comes

link.on("hello", (what) => {
  const another = hello?.run !== what.run;
  hello = what;
  if (sonar >= hello.sonars.length) sonar = 0;
  byId("sonar").replaceChildren(...hello.sonars.map((s, k) => make("option", { value: k, text: s.name })));
  byId("sonar").value = sonar;
  if (another) track.clear();
  choose(another);
});

link.on("state", (what) => {
  state = what;
  if (hello) refresh();
});

link.on("world", (world) => world && track.set(world));
link.on("relief", (frame) => track.relief(frame));
link.on("dropped", (n) => notice(`this page skipped ${n} frames because it is too slow`));
link.on("error", (why) => notice(why));
link.on("line", (frame) => {
  if (frame.sonar !== sonar || !waterfall.add(frame)) return;
  track.add(frame);
  motion.add(frame);
  health.add(frame);
  say(byId("ping"), String(frame.ping));
});
for (const [kind, view] of [["fan", fan], ["elements", elements], ["scope", scope]]) {
  link.on(kind, (frame) => frame.sonar === sonar && view.add(frame));
}

link.on("open", () => {
  byId("banner").hidden = true;
});
link.on("closed", () => {
  pill("bad", "no connection");
  notice("The daemon does not answer. This page reconnects automatically.", true);
});
link.on("token", () => !byId("ask-token").open && byId("ask-token").showModal());
byId("token-form").addEventListener("submit", () => {
  sessionStorage.setItem("token", byId("token").value);
  byId("token").value = "";
});

// ---- what is looked at

function choose(anew) {
  const rig = hello.sonars[sonar];
  document.title = `${rig.name} · Echotank`;
  if (anew) {
    waterfall.clear();
    motion.clear();
    fan.clear();
    track.restart();
    scope.sonar(rig);
    elements.sonar(rig);
  }
  controls.sonar(hello, sonar);
  look();
}

/** Only what is in sight is asked for. */
function look() {
  if (!hello) return;
  const seen = (pane) => !byId(pane).hidden;
  link.send({ look: { sonar, fan: seen("pane-fan"), elements: seen("pane-elements"), scope: seen("pane-scope") ? scope.want : null } });
}

byId("sonar").addEventListener("change", (e) => {
  sonar = Number(e.target.value);
  choose(true);
  if (state) refresh();
});

function refresh() {
  const s = state.sonars[sonar];
  controls.show(state);
  elements.setFaults(state.faults.map(ofElements), hello.sonars[sonar].name);
  motion.sources(state.nav, state.nav_owners);
  health.show(state, sonar);
  const c = s.counters;
  if (state.health_problem) pill("bad", state.health_problem);
  else if (state.paused) pill("warn", state.clock === "lockstep" ? "lockstep" : "paused");
  else if (!s.settings.pinging) pill("warn", s.trigger === "external" ? "waiting for triggers" : "not pinging");
  else pill("good", state.clock === "realtime" ? "pinging" : state.clock === "scaled" ? `pinging ×${digits(state.rate, 1)}` : state.clock);
  say(byId("clock"), `${new Date(state.rig_utc_ms).toISOString().slice(0, 10)} ${timeOf(state.rig_utc_ms, 0)}`);
  const skipped = c.pings_skipped_nav + c.pings_skipped_late + c.pings_skipped_queue;
  say(byId("trouble"), `${c.deadline_misses} / ${skipped}`);
  const lost = s.streams.reduce((sum, stream) => sum + stream.records_dropped, 0);
  say(byId("clients"), `${s.streams.length}${lost ? `, ${lost} records lost` : ""}`);
}

function pill(is, text) {
  byId("state").dataset.is = is;
  say(byId("state"), text);
}

let until = 0;
function notice(text, stays = false) {
  const banner = byId("banner");
  say(banner, text);
  banner.hidden = false;
  clearTimeout(until);
  if (!stays) until = setTimeout(() => (banner.hidden = true), 5000);
}

// ---- tabs and keys

function show(id) {
  const tab = byId(id);
  const list = tab.closest('[role="tablist"]');
  for (const other of list.querySelectorAll('[role="tab"]')) {
    const is = other === tab;
    other.setAttribute("aria-selected", String(is));
    other.tabIndex = is ? 0 : -1;
    byId(other.getAttribute("aria-controls")).hidden = !is;
  }
  look();
  if (state && hello) refresh();
}

for (const list of document.querySelectorAll('[role="tablist"]')) {
  const tabs = [...list.querySelectorAll('[role="tab"]')];
  tabs.forEach((tab, k) => {
    tab.addEventListener("click", () => show(tab.id));
    tab.addEventListener("keydown", (e) => {
      const by = { ArrowRight: 1, ArrowLeft: -1 }[e.key];
      if (!by) return;
      const next = tabs[(k + by + tabs.length) % tabs.length];
      show(next.id);
      next.focus();
    });
  });
}

const KEYS = {
  " ": () => controls.pause(),
  ".": () => controls.step(),
  p: () => controls.single(),
  "[": () => controls.range(0.9),
  "]": () => controls.range(1.1),
  t: () => byId("wf-truth").click(),
  c: () => {
    const map = byId("wf-map");
    map.value = mapNames[(mapNames.indexOf(map.value) + 1) % mapNames.length];
    waterfall.recolour();
  },
  "?": () => byId("about").showModal(),
  1: () => show("tab-fan"),
  2: () => show("tab-scope"),
  3: () => show("tab-elements"),
  4: () => show("tab-track"),
  5: () => show("tab-motion"),
  6: () => show("tab-health"),
};
document.addEventListener("keydown", (e) => {
  const typing = e.target.closest("input, select, button, dialog, textarea");
  if (typing || e.ctrlKey || e.metaKey || e.altKey || e.repeat || !(e.key in KEYS)) return;
  e.preventDefault();
  KEYS[e.key]();
});

byId("help").addEventListener("click", KEYS["?"]);
byId("theme").addEventListener("click", () => {
  const dark = matchMedia("(prefers-color-scheme: dark)").matches;
  const now = document.documentElement.dataset.theme ?? (dark ? "dark" : "light");
  document.documentElement.dataset.theme = now === "dark" ? "light" : "dark";
  document.dispatchEvent(new Event("themechange"));
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => document.dispatchEvent(new Event("themechange")));

link.open();
