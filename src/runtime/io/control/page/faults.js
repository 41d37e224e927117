// Faults: the form, grouped by what a value decides, and the list of those at work.
import { byId, make, say, short } from "./lib.js";

const OF_TWO = new Set(["swapped", "crosstalk"]);
const isOfElement = (kind) => kind.group === "elements";
const isOfNav = (kind) => kind.group === "navigation";
/** Faults of the bytes of sentences affect all quantities. */
const OF_BYTES = new Set(["nav-checksum", "nav-cut", "nav-noise"]);

export class Faults {
  constructor(ask) {
    this.ask = ask;
    this.form = byId("fault-form");
    byId("fault-kind").addEventListener("change", () => this.#shape());
    byId("faults-clear").addEventListener("click", () => ask({ do: "clear-faults" }));
    this.form.addEventListener("submit", (e) => {
      e.preventDefault();
      this.#inject(new FormData(e.target));
    });
  }

  /** The rig, and which of its sonars is looked at. */
  sonar(hello, index) {
    this.hello = hello;
    this.rig = hello.sonars[index];
    const kind = byId("fault-kind");
    const was = kind.value;
    const groups = [...new Set(hello.faults.map((f) => f.group))];
    kind.replaceChildren(...groups.map((group) => make("optgroup", { label: group }, ...hello.faults.filter((f) => f.group === group).map((f) => make("option", { value: f.kind, text: f.kind })))));
    if (was) kind.value = was;
    const { array, source, quantity } = this.form.elements;
    const options = (all, names, valueOf) => [make("option", { value: "", text: all }), ...names.map((name, k) => make("option", { value: valueOf(name, k), text: name }))];
    array.replaceChildren(...options("all", this.rig.arrays.map((a) => a.name), (_, k) => k));
    source.replaceChildren(...options("all", hello.nav, (name) => name));
    quantity.replaceChildren(...options("all", hello.quantities, (name) => name));
    this.#shape();
  }

  get #kind() {
    return this.hello.faults.find((f) => f.kind === byId("fault-kind").value);
  }

  /** Shows what the kind takes. */
  #shape() {
    const kind = this.#kind;
    const { value, quantity } = this.form.elements;
    say(byId("fault-effect"), kind.effect);
    say(byId("fault-unit"), kind.unit ? `Value, ${kind.unit}` : "Value");
    say(byId("fault-range"), kind.unit ? `From ${short(kind.min)} to ${short(kind.max)} ${kind.unit}.` : "");
    byId("fault-value").hidden = !kind.unit;
    value.disabled = !kind.unit;
    value.required = Boolean(kind.unit);
    const of = { element: isOfElement(kind), two: OF_TWO.has(kind.kind), nav: isOfNav(kind), quantity: isOfNav(kind) && !OF_BYTES.has(kind.kind) };
    for (const part of this.form.querySelectorAll("[data-of]")) {
      part.hidden = !of[part.dataset.of];
      for (const field of part.matches("input, select") ? [part] : part.querySelectorAll("input, select")) field.disabled = part.hidden || Boolean(field.closest("[data-of][hidden]"));
    }
    quantity.required = kind.kind === "nav-wrong";
    byId("fault-where").hidden = !of.element && !of.nav;
  }

  #inject(data) {
    const command = { do: "fault" };
    // Navigation serves every sonar.
    if (!isOfNav(this.#kind)) command.sonar = this.rig.name;
    for (const [key, text] of data) {
      if (text === "") continue;
      command[key] = ["kind", "source", "quantity"].includes(key) ? text : Number(text);
    }
    this.ask(command, byId("fault-note"));
  }

  show(state) {
    say(byId("faults-count"), state.faults.length ? `${state.faults.length} active, ${state.faults_injected} injected` : "none");
    byId("faults-clear").disabled = state.faults.length === 0;
    const key = JSON.stringify(state.faults.map((f) => [f.fault, f.injected]));
    const list = byId("faults");
    if (this.key !== key || state.faults.some((f) => f.for_s)) {
      this.key = key;
      const kept = new Map([...list.children].map((li) => [li.dataset.fault, li]));
      list.replaceChildren(...state.faults.map((f) => this.#item(f, state, kept.get(String(f.fault)))));
    }
  }

  #item(f, state, kept) {
    const item = kept ?? make("li", { "data-fault": f.fault }, make("span", { class: "name" }), make("span", { class: "when" }), make("button", { type: "button", text: "×", "aria-label": `Remove fault ${f.fault}`, onclick: () => this.ask({ do: "clear-faults", fault: f.fault }) }), make("progress", { max: 1, value: 0, "aria-label": "Progress" }));
    const [name, when, , progress] = item.children;
    say(name, inWords(f, this.rig));
    const [words, share, isActive] = timeline(f, state.rig_utc_ms);
    say(when, `${words}, injected ${f.injected}`);
    name.dataset.is = isActive ? "good" : "";
    progress.value = share;
    progress.hidden = !f.for_s;
    return item;
  }

  /** Those of elements, for the view of the elements. */
  ofElements(state) {
    const kinds = new Set(this.hello.faults.filter(isOfElement).map((f) => f.kind));
    return state.faults.filter((f) => kinds.has(f.kind));
  }
}

function inWords(f, sonar) {
  const where = [];
  if (f.array !== undefined) where.push(sonar.arrays[f.array]?.name ?? f.array);
  if (f.element !== undefined) where.push(f.element);
  if (f.other !== undefined) where.push(`and ${f.other}`);
  if (f.source !== undefined) where.push(f.source);
  if (f.quantity !== undefined) where.push(f.quantity);
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
