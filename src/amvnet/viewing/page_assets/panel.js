// The panel: labels, colours with their key, and classes to show or hide. Names are inserted only as text.
"use strict";

const byId = (id) => document.getElementById(id);
const share = (part, whole) => (whole ? `${((100 * part) / whole).toFixed(1)} %` : "–");
const counted = (count) => count.toLocaleString("en");
const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);
const cssColor = ([r, g, b]) => `rgb(${r}, ${g}, ${b})`;

/** Return an HTML element with a CSS class, a text, children and other properties. */
function element(kind, { name = "", text = "", children = [], ...rest } = {}) {
  const made = document.createElement(kind);
  if (name) made.className = name;
  if (text) made.textContent = text;
  made.append(...children);
  return Object.assign(made, rest);
}

function swatch(color) {
  const made = element("span", { name: "swatch" });
  made.style.background = cssColor(color);
  return made;
}

/** Return a row of the panel: a swatch, a name and a value. */
function row(kind, color, text, value) {
  const texts = [element("span", { name: "name", text, title: text }), element("span", { name: "value", text: value })];
  return element(kind, { children: color ? [swatch(color), ...texts] : texts });
}

/** Fill a group with radio buttons; arrow keys move the choice. */
function choices(group, keys, chosen, make, choose) {
  const focused = group.contains(document.activeElement);
  const buttons = keys.map((key) => {
    const button = make(key);
    button.setAttribute("role", "radio");
    button.setAttribute("aria-checked", String(key === chosen));
    button.tabIndex = key === chosen ? 0 : -1;
    button.onclick = () => choose(key);
    return button;
  });
  group.replaceChildren(...buttons);
  group.onkeydown = (event) => {
    const step = { ArrowDown: 1, ArrowRight: 1, ArrowUp: -1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    event.preventDefault();
    event.stopPropagation();
    choose(keys[(keys.indexOf(chosen) + step + keys.length) % keys.length]);
  };
  if (focused) buttons[keys.indexOf(chosen)]?.focus();
}

/** Fill the table of the labels' scores: rows for classes and overall figures, a column for each method. */
function fillTable({ methods, rows, totals, scans, uncertain }) {
  const doubts = uncertain === null ? "" : `, ${uncertain.toFixed(1)} % uncertain`;
  byId("table-title").textContent = `IoU in % · ${scans} scan${scans > 1 ? "s" : ""}${doubts}`;
  const cells = (kind, first, values) => element("tr", {
    name: kind,
    children: [element("th", { children: first }), ...values.map((text) => element("td", { text }))],
  });
  const number = (value) => (value === null ? "–" : value.toFixed(1));
  byId("table").querySelector("table").replaceChildren(
    cells("head", [], methods.map(capital)),
    ...rows.map(({ class: id, values }) =>
      cells("", [swatch(about.colors[id]), element("span", { text: about.classes[id] })], values.map(number))),
    ...totals.map(({ name, values }) => cells("total", [element("span", { text: name })], values.map(number))),
  );
}

class Panel {
  /** `change` is called with changes of the look. */
  constructor(change) {
    this.change = change;
    byId("title").textContent = about.title;
    byId("labels-section").hidden = byId("classes-section").hidden = !about.sources.length;
    byId("only-section").hidden = possible.only.length < 2;
    byId("all").onclick = () => change({ hidden: new Set() });
    byId("none").onclick = () => change({ hidden: new Set(about.classes.keys()) });
    byId("size").oninput = (event) => change({ size: Number(event.target.value) });
    byId("fold").onclick = () => this.fold();
    byId("show-table").hidden = !about.table;
    if (about.table) fillTable(about.table);
    if (this.narrow) this.fold();
  }

  get narrow() {
    return matchMedia("(max-width: 700px)").matches;
  }

  fold() {
    const folded = byId("panel").classList.toggle("folded");
    byId("fold").setAttribute("aria-expanded", String(!folded));
  }

  /** Return the middle of the part of the window that the panel does not cover, in clip space. */
  free() {
    const { right, top, height } = byId("panel").getBoundingClientRect();
    if (this.narrow) return [0, 1 - top / innerHeight];
    return [height > innerHeight / 3 ? right / innerWidth : 0, 0];
  }

  show(look, scan) {
    const { all, drawn } = tally(look, scan), total = drawn.reduce((a, b) => a + b, 0);
    byId("subtitle").textContent = `${scan.name} · ${counted(scan.count)} points`;
    byId("drawn").textContent = `${counted(total)} points drawn${scan.note ? `; ${scan.note}` : ""}`;
    byId("size").value = look.size;
    this.showLabels(look, scan);
    choices(byId("colors"), possible.color, look.color, (key) => element("button", { text: TITLES[key] }),
      (color) => this.change({ color }));
    choices(byId("only"), possible.only, look.only, (key) => element("button", { text: capital(key) }),
      (only) => this.change({ only }));
    this.showKey(look, scan);
    this.showClasses(look, all);
    return drawn;
  }

  /** Show the labels that can be chosen, with the share of their correct points in this scan. */
  showLabels(look, scan) {
    const make = (key) => {
      const { title } = about.sources.find((source) => source.key === key);
      const { scored, wrong } = key === "truth" ? { scored: 0 } : errorsOf(scan, key);
      return row("button", null, title, scored ? share(scored - wrong, scored) : "");
    };
    byId("correct").hidden = !scan.planes.truth || !predictions.length;
    choices(byId("labels"), possible.labels, look.labels, make, (labels) => this.change({ labels }));
  }

  showKey(look, scan) {
    const key = byId("key");
    key.replaceChildren();
    if (look.color === "error") key.append(this.errorKey(look, scan));
    else if (look.color !== "class") key.append(...this.rampKey(look, scan));
  }

  errorKey(look, scan) {
    const { scored, wrong } = errorsOf(scan, look.labels);
    const rows = [
      row("div", about.marks.wrong, "wrong", share(wrong, scored)),
      row("div", about.marks.correct, "correct", share(scored - wrong, scored)),
      row("div", about.marks.unscored, "no class in truth", counted(scan.count - scored)),
    ];
    return element("div", { name: "rows", children: rows });
  }

  rampKey(look, scan) {
    const bar = element("canvas", { width: 256, height: 1 }), [low, high] = look.range();
    const pixels = new ImageData(new Uint8ClampedArray(rampOf(look.color)), 256, 1);
    bar.getContext("2d").putImageData(pixels, 0, 0);
    const ends = {
      uncertainty: ["networks agree", "disagree"],
      height: [`${low.toFixed(1)} m`, `${high.toFixed(1)} m above the sensor`],
      intensity: [low.toFixed(2), high.toFixed(2)],
    }[look.color];
    const texts = ends.map((text) => element("span", { text }));
    const shown = [bar, element("div", { name: "ends", children: texts })];
    return look.color === "uncertainty" ? [...shown, this.doubtKey(scan)] : shown;
  }

  doubtKey(scan) {
    const doubted = (scan.planes.uncertain ?? []).reduce((sum, value) => sum + value, 0);
    return element("div", { name: "rows", children: [row("div", null, "uncertain", share(doubted, scan.count))] });
  }

  /** Show a row for each class of any scan; a click with alt shows only this class. */
  showClasses(look, all) {
    const list = byId("classes"), focused = document.activeElement?.dataset?.id;
    const rows = about.present.map((id) => {
      const button = row("button", about.colors[id], about.classes[id], counted(all[id]));
      button.setAttribute("aria-pressed", String(!look.hidden.has(id)));
      button.dataset.id = id;
      button.onclick = ({ altKey }) => this.change({ hidden: altKey ? this.others(look, id) : this.toggled(look, id) });
      return button;
    });
    list.replaceChildren(...rows);
    if (focused !== undefined) list.querySelector(`[data-id="${focused}"]`)?.focus();
  }

  toggled(look, id) {
    const hidden = new Set(look.hidden);
    if (!hidden.delete(id)) hidden.add(id);
    return hidden;
  }

  others(look, id) {
    const others = [...about.classes.keys()].filter((other) => other !== id);
    const alone = !look.hidden.has(id) && others.every((other) => look.hidden.has(other));
    return new Set(alone ? [] : others);
  }
}
