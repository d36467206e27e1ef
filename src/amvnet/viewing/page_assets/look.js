// The look of the page: what it shows and how. The page's address keeps it (#color=error&hide=1,2), so that a link
// shows the same look.
"use strict";

const SIZES = [0.4, 4];  // the smallest and the largest size of a point, relative to the usual size
// The box that holds all points: x, y, z of its lowest and of its highest corner, metres.
const NO_BOX = [-9999, -9999, -9999, 9999, 9999, 9999];
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
    intensity: about.ranges.intensity[1] > 0,  // a scan without intensities has zeros
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

  /** Apply changes, and correct combinations that show nothing. */
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

  /** Take the look from the address, with defaults for missing or invalid values; return the camera's numbers. */
  read(hash) {
    const given = new URLSearchParams(hash.replace(/^#/, ""));
    const chosen = (name) => (possible[name].includes(given.get(name)) ? given.get(name) : firstLook[name]);
    const number = (name, low, high) => {
      const value = given.has(name) ? Number(given.get(name)) : NaN;
      return Number.isFinite(value) ? Math.min(Math.max(value, low), high) : firstLook[name];
    };
    const ids = (given.get("hide") ?? "").split(",").filter((text) => /^\d+$/.test(text)).map(Number);
    this.hidden = new Set(possible.labels.length ? ids.filter((id) => id < about.classes.length) : []);
    this.labels = chosen("labels");
    this.set({
      scan: Math.round(number("scan", 1, about.scans.length) || 1) - 1,
      color: chosen("color"),
      only: chosen("only"),
      size: number("size", ...SIZES),
      box: boxOf((given.get("box") ?? "").split(",").map(Number)),
      shading: given.get("shading") !== "0",
      rings: given.get("rings") !== "0",
    });
    return (given.get("camera") ?? "").split(",").map(Number);
  }

  /** Return the address of this look; it leaves out default values. */
  hash(camera) {
    const values = new URLSearchParams();
    if (this.scan) values.set("scan", this.scan + 1);
    for (const name of ["color", "labels", "only", "size"]) {
      if (this[name] !== firstLook[name]) values.set(name, this[name]);
    }
    if (this.box !== NO_BOX) values.set("box", this.box.join(","));
    if (this.hidden.size) values.set("hide", [...this.hidden].sort((a, b) => a - b).join(","));
    for (const name of ["shading", "rings"]) if (!this[name]) values.set(name, "0");
    values.set("camera", camera.map((value) => Number(value.toFixed(3))).join(","));
    return "#" + values.toString().replaceAll("%2C", ",");
  }
}

/** Return six numbers as a box; return `NO_BOX` if they are no box. */
function boxOf(numbers) {
  const whole = numbers.length === 6 && numbers.every(Number.isFinite);
  const box = whole ? numbers.map((value) => Math.min(Math.max(value, NO_BOX[0]), NO_BOX[3])) : NO_BOX;
  return box.every((value, place) => value === NO_BOX[place]) ? NO_BOX : box;
}

const ramps = new Map();

/** Return the 256 RGBA colours of a ramp, interpolated between its stops. */
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

/** Return a function that says whether the point with an index is drawn, by the same rule as the shader. */
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

/** Count all points and the drawn points of each class in a scan, by id: {all: [...], drawn: [...]}. */
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

/** Count the points that have a true class, and the points whose label is another class: {scored, wrong}. */
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
