// The measuring tape shows the distance between two points that were clicked.
"use strict";

class Tape {
  constructor(redraw) {
    Object.assign(this, { redraw, on: false, ends: [] });
  }

  toggle() {
    this.on = !this.on;
    byId("measure").setAttribute("aria-pressed", String(this.on));
    this.clear();
  }

  clear() {
    this.ends = [];
    this.redraw();
  }

  /** Add a point; a third point begins a new measurement. */
  add(point) {
    this.ends = this.ends.length === 1 ? [...this.ends, point] : [point];
    this.redraw();
  }

  draw(scan, matrix) {
    const canvas = byId("canvas"), { clientWidth: width, clientHeight: height } = canvas;
    const places = this.ends.map((end) => placeOf(scan, end));
    const seen = places.map((place) => projected(place, matrix));
    const visible = this.on && seen.length === 2 && seen.every(([, , , w]) => w > 0);
    byId("tape").toggleAttribute("hidden", !visible);
    byId("length").hidden = !this.on || (seen.length === 2 && !visible);
    byId("length").textContent = this.words(places);
    document.documentElement.dataset.length = places.length === 2 ? metresBetween(...places).toFixed(2) : "";
    if (!visible) {
      byId("length").style.left = byId("length").style.top = "";
      return;
    }
    const [[x1, y1], [x2, y2]] = seen.map(([u, v, , w]) => [((u / w + 1) / 2) * width, ((1 - v / w) / 2) * height]);
    const line = byId("tape").querySelector("line");
    for (const [name, value] of Object.entries({ x1, y1, x2, y2 })) line.setAttribute(name, value);
    byId("length").style.left = `${(x1 + x2) / 2}px`;
    byId("length").style.top = `${(y1 + y2) / 2}px`;
  }

  words(places) {
    if (places.length < 2) return places.length ? "click the second point" : "click the first point";
    const [[x1, y1, z1], [x2, y2, z2]] = places;
    const flat = Math.hypot(x2 - x1, y2 - y1).toFixed(2), up = (z2 - z1).toFixed(2);
    return `${metresBetween(...places).toFixed(2)} m (along the ground ${flat}, up ${up})`;
  }
}

function metresBetween(a, b) {
  return Math.hypot(...a.map((value, axis) => value - b[axis]));
}
