// The page put together: what comes over the link goes to its views.
import { byId, digits, make, mapNames, say, stampOf, timeOf } from "./lib.js";
import { Link } from "./link.js";
import { Waterfall } from "./waterfall.js";
import { Fan } from "./fan.js";
import { Scope } from "./scope.js";
import { Elements } from "./elements.js";
import { Track } from "./track.js";
import { Motion } from "./motion.js";
import { Health } from "./health.js";
import { Bathymetry } from "./bathymetry.js";
import { Controls } from "./controls.js";
import { Faults } from "./faults.js";
import { Profile } from "./profile.js";
import { Verdict } from "./verdict.js";

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
const bathymetry = new Bathymetry();
const controls = new Controls(link);
const profile = new Profile((command) => controls.ask(command));
const faults = new Faults((command, note) => controls.ask(command, note));
const verdict = new Verdict();

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
  if (another) {
    track.clear();
    verdict.clear();
    profile.rig(hello);
  }
  choose(another);
});

link.on("state", (what) => {
  state = what;
  verdict.take(state);
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
  bathymetry.ship(frame);
  say(byId("ping"), String(frame.ping));
});
for (const [kind, view] of [["fan", fan], ["elements", elements], ["scope", scope], ["soundings", bathymetry]]) {
  link.on(kind, (frame) => frame.sonar === sonar && view.add(frame));
}

link.on("closed", () => {
  tell("bad", "no connection", "the daemon does not answer; this page reconnects automatically");
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
    bathymetry.clear();
    track.restart();
    scope.sonar(rig);
    elements.sonar(rig);
  }
  controls.sonar(hello, sonar);
  faults.sonar(hello, sonar);
  byId("tab-bathymetry").hidden = !rig.bottom_detection;
  if (!rig.bottom_detection && !byId("pane-bathymetry").hidden) show("tab-track");
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
  faults.show(state);
  elements.setFaults(faults.ofElements(state), hello.sonars[sonar].name);
  motion.sources(state.nav, state.nav_owners);
  health.show(hello, state, sonar, verdict.checks);
  const c = s.counters;
  const { is, reasons } = verdict.worst;
  const waits = state.paused || !s.settings.pinging;
  const doing = state.paused ? (state.clock === "lockstep" ? "lockstep" : "paused")
    : waits ? (s.trigger === "external" ? "waiting for triggers" : "not pinging")
    : state.clock === "realtime" ? "pinging" : state.clock === "scaled" ? `pinging ×${digits(state.rate, 1)}` : state.clock;
  const hint = state.paused ? "time stands still; Resume goes on" : s.trigger === "external" ? "each trigger gives a ping" : "Start begins to ping";
  if (is === "good") tell(waits ? "warn" : "good", doing, waits ? hint : "pings on time, navigation and recordings in order, no record lost");
  else tell(is, doing, reasons.join("; "));
  const skipped = c.pings_skipped_nav + c.pings_skipped_late + c.pings_skipped_queue;
  const lost = s.streams.reduce((sum, stream) => sum + stream.records_dropped, 0);
  say(byId("since"), `since the start: ${c.deadline_misses} late, ${skipped} skipped, ${lost} records lost`);
  say(byId("clock"), `${new Date(state.rig_utc_ms).toISOString().slice(0, 10)} ${timeOf(state.rig_utc_ms, 0)}`);
  say(byId("clients"), String(s.streams.length));
  for (const list of document.querySelectorAll("[data-save-of]")) {
    const view = VIEWS[shownTab(list.dataset.saveOf)];
    list.querySelector("[data-save=picture]").disabled = !view?.savePicture || view.isEmpty;
    list.querySelector("[data-save=data]").disabled = !view?.saveData || view.isEmpty;
  }
}

/** The bar of the state: its colour, what the rig does, and why it is not all green. */
function tell(is, doing, reason) {
  byId("verdict").dataset.is = is;
  say(byId("state"), doing);
  say(byId("reason"), reason);
  byId("verdict").title = reason;
}

let until = 0;
function notice(text) {
  const banner = byId("banner");
  say(banner, text);
  banner.hidden = false;
  clearTimeout(until);
  until = setTimeout(() => (banner.hidden = true), 5000);
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
  const all = [...list.querySelectorAll('[role="tab"]')];
  all.forEach((tab) => {
    tab.addEventListener("click", () => show(tab.id));
    tab.addEventListener("keydown", (e) => {
      const by = { ArrowRight: 1, ArrowLeft: -1 }[e.key];
      if (!by) return;
      const tabs = all.filter((t) => !t.hidden);
      const next = tabs[(tabs.indexOf(tab) + by + tabs.length) % tabs.length];
      show(next.id);
      next.focus();
    });
  });
}

const VIEWS = { "tab-fan": fan, "tab-scope": scope, "tab-elements": elements, "tab-track": track, "tab-bathymetry": bathymetry, "tab-motion": motion, "tab-health": health };
const shownTab = (list) => byId(list).querySelector('[aria-selected="true"]').id;

// ---- pictures and data

/** Saves what a view shows, named by sonar, view and time of the rig. */
function save(view, what, how) {
  const name = `echotank-${hello.sonars[sonar].name}-${what}-${stampOf(state.rig_utc_ms)}`;
  const title = `${hello.sonars[sonar].name}: ${what}, ${new Date(state.rig_utc_ms).toISOString().slice(0, 19).replace("T", " ")} UTC`;
  if (how === "picture") view.savePicture(name, title);
  else view.saveData(name, title);
}
for (const list of document.querySelectorAll("[data-save-of]")) {
  for (const button of list.querySelectorAll("[data-save]")) {
    button.addEventListener("click", () => {
      const tab = shownTab(list.dataset.saveOf);
      save(VIEWS[tab], byId(tab).textContent.toLowerCase(), button.dataset.save);
    });
  }
}
for (const how of ["picture", "data"]) byId(`wf-${how}`).addEventListener("click", () => waterfall.lines.length && save(waterfall, "waterfall", how));

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
  7: () => byId("tab-bathymetry").hidden || show("tab-bathymetry"),
};
/** What a number field takes itself. */
const IN_NUMBERS = /^[\d.eE+-]$/;

/** A control that was clicked does not keep the keys; one that was reached by Tab keeps those that it uses. */
let byPointer = false;
document.addEventListener("pointerdown", () => (byPointer = true), true);
document.addEventListener("keydown", (e) => {
  if (e.key === "Tab") byPointer = false;
}, true);

function keeps(target, key) {
  if (target.closest("dialog, textarea, [type=password], [type=text]")) return true;
  if (target.matches("[type=number]")) return IN_NUMBERS.test(key);
  if (target.matches("select")) return !byPointer;
  return target.matches("button, summary, [type=checkbox]") && key === " " && !byPointer;
}

document.addEventListener("keydown", (e) => {
  if (e.ctrlKey || e.metaKey || e.altKey || e.repeat || !(e.key in KEYS) || keeps(e.target, e.key)) return;
  // Else the space bar would also press a button that was clicked.
  if (byPointer && e.target.matches("button, select, [type=checkbox]")) e.target.blur();
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
