// What is shown and how. The address keeps it (#color=error&hide=1,2), so that a link shows the same.
"use strict";

const SIZES = [0.4, 4];
const NO_BOX = [-9999, -9999, -9999, 9999, 9999, 9999];  // metres: x, y, z of the lowest and the highest corner
const TITLES = { class: "Class", error: "Error", uncertainty: "Uncertainty", height: "Height", intensity: "Intensity" };
const predictions = about.sources.map((source) => source.key).filter((key) => key !== "truth");
const has = (plane) => about.scans.some((scan) => scan.planes.includes(plane));

/** The colourings, selections of points and labels for which the page has data. */
const possible = {
  color: MODES.filter((mode) => ({
    class: about.sources.length > 0,
    error: has("truth") && predictions.length > 0,
    uncertainty: has("disagreement"),
    height: true,
    intensity: true,
  })[mode]),
  only: ONLY.filter((only) => ({
    all: true,
    wrong: has("truth") && predictions.length > 0,
    uncertain: has("uncertain"),
  })[only]),
  labels: about.sources.map((source) => source.key),
};

const firstLook = {
  scan: 0,
  color: possible.color[0],
  labels: predictions.at(-1) ?? possible.labels[0] ?? "",
  only: "all",
  size: 1,
  shading: true,
  rings: true,
  box: NO_BOX,
};

class Look {
  constructor() {
    Object.assign(this, firstLook, { hidden: new Set() });
  }

  /** Apply changes, and correct combinations that would show nothing. */
  set(changes) {
    Object.assign(this, changes);
    if (this.labels === "truth" && (this.color === "error" || this.only === "wrong")) {
      if (!changes.labels) this.labels = predictions.at(-1);
      else if (this.color === "error") this.color = "class";
      if (changes.labels && this.only === "wrong") this.only = "all";
    }
  }

  classColors() {
    const bytes = new Uint8Array(4 * 256);
    about.colors.forEach((color, id) => bytes.set([...color, this.hidden.has(id) ? 0 : 255], 4 * id));
    return bytes;
  }

  rampColors() {
    return rampOf(this.color);
  }

  range() {
    return about.ranges[this.color] ?? [0, 1];
  }

  /** Read the address, with defaults for missing or invalid values; return the camera's numbers. */
  read(hash) {
    const said = new URLSearchParams(hash.replace(/^#/, ""));
    const chosen = (name) => (possible[name].includes(said.get(name)) ? said.get(name) : firstLook[name]);
    const number = (name, low, high) => {
      const value = said.has(name) ? Number(said.get(name)) : NaN;
      return Number.isFinite(value) ? Math.min(Math.max(value, low), high) : firstLook[name];
    };
    const ids = (said.get("hide") ?? "").split(",").filter((text) => /^\d+$/.test(text)).map(Number);
    this.hidden = new Set(possible.labels.length ? ids.filter((id) => id < about.classes.length) : []);
    this.labels = chosen("labels");
    this.set({
      scan: Math.round(number("scan", 1, about.scans.length) || 1) - 1,
      color: chosen("color"),
      only: chosen("only"),
      size: number("size", ...SIZES),
      box: boxOf((said.get("box") ?? "").split(",").map(Number)),
      shading: said.get("shading") !== "0",
      rings: said.get("rings") !== "0",
    });
    return (said.get("camera") ?? "").split(",").map(Number);
  }

  /** Return the address of this look, without values that are the defaults. */
  hash(camera) {
    const said = new URLSearchParams();
    if (this.scan) said.set("scan", this.scan + 1);
    for (const name of ["color", "labels", "only", "size"]) {
      if (this[name] !== firstLook[name]) said.set(name, this[name]);
    }
    if (this.box !== NO_BOX) said.set("box", this.box.join(","));
    if (this.hidden.size) said.set("hide", [...this.hidden].sort((a, b) => a - b).join(","));
    for (const name of ["shading", "rings"]) if (!this[name]) said.set(name, "0");
    said.set("camera", camera.map((value) => Number(value.toFixed(3))).join(","));
    return "#" + said.toString().replaceAll("%2C", ",");
  }
}

/** Return six numbers as a box; none of numbers that are no box. */
function boxOf(numbers) {
  const whole = numbers.length === 6 && numbers.every(Number.isFinite);
  const box = whole ? numbers.map((value) => Math.min(Math.max(value, NO_BOX[0]), NO_BOX[3])) : NO_BOX;
  return box.every((value, place) => value === NO_BOX[place]) ? NO_BOX : box;
}

const ramps = new Map();

/** Return the 256 colours of a ramp, interpolated between its stops. */
function rampOf(name) {
  if (!ramps.has(name)) {
    const stops = about.ramps[name] ?? [[0, 0, 0]], bytes = new Uint8Array(4 * 256);
    for (let i = 0; i < 256; i++) {
      const place = (i / 255) * (stops.length - 1), low = Math.floor(place), high = Math.ceil(place);
      for (let c = 0; c < 3; c++) bytes[4 * i + c] = stops[low][c] + (place - low) * (stops[high][c] - stops[low][c]);
      bytes[4 * i + 3] = 255;
    }
    ramps.set(name, bytes);
  }
  return ramps.get(name);
}

/** Return a function that says whether a point is drawn, by the same rule as the shader. */
function shownBy(look, scan) {
  const ids = scan.planes[look.labels], { truth, uncertain } = scan.planes, boxed = look.box !== NO_BOX;
  return (i) => {
    const id = ids ? ids[i] : 0;
    if (look.hidden.has(id) || (boxed && !inBox(placeOf(scan, i), look.box))) return false;
    if (look.only === "wrong") return Boolean(truth && truth[i] && truth[i] !== id);
    return look.only === "all" || Boolean(uncertain && uncertain[i]);
  };
}

function inBox([x, y, z], [x0, y0, z0, x1, y1, z1]) {
  return x >= x0 && x <= x1 && y >= y0 && y <= y1 && z >= z0 && z <= z1;
}

/** Count the points of each class in a scan, and those that are drawn: {all: [...], drawn: [...]}, by id. */
function tally(look, scan) {
  const ids = scan.planes[look.labels], shown = shownBy(look, scan);
  const all = new Array(about.classes.length).fill(0), drawn = [...all];
  for (let i = 0; i < scan.count; i++) {
    const id = ids ? ids[i] : 0;
    all[id]++;
    if (shown(i)) drawn[id]++;
  }
  return { all, drawn };
}

/** Count the points with a true class, and those that the labels give another class: {scored, wrong}. */
function errorsOf(scan, labels) {
  const { truth } = scan.planes, ids = scan.planes[labels];
  if (!truth || !ids) return { scored: 0, wrong: 0 };
  let scored = 0, wrong = 0;
  for (let i = 0; i < scan.count; i++) {
    if (!truth[i]) continue;
    scored++;
    if (truth[i] !== ids[i]) wrong++;
  }
  return { scored, wrong };
}
