// Turn mouse, touch and keys into movements of the camera, clicks and calls.
"use strict";

const CLICK_TRAVEL = 5;  // the farthest that a pointer may move during a click, pixels
const DOUBLE_CLICK = 400;  // the longest time between the clicks of a double click, milliseconds

/**
 * Turns, moves and zooms the camera with pointers. It calls `on.camera()` after a change, and
 * `on.click(x, y, isDouble)` after a click.
 */
class Pointers {
  constructor(canvas, camera, on) {
    Object.assign(this, { canvas, camera, on });
    this.down = new Map();  // the last position of each pressed pointer, by its id
    this.last = { time: 0, x: 0, y: 0 };
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => this.release(event));
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  press(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.canvas.classList.add("moving");
    this.canvas.focus({ preventScroll: true });
    this.down.set(event.pointerId, { x: event.clientX, y: event.clientY });
    this.travelled = this.down.size > 1 ? Infinity : 0;
  }

  drag(event) {
    const before = this.down.get(event.pointerId);
    if (!before) return;
    const now = { x: event.clientX, y: event.clientY }, dx = now.x - before.x, dy = now.y - before.y;
    this.travelled += Math.hypot(dx, dy);
    if (this.down.size > 1) this.pinch(event.pointerId, before, now);
    else if (event.shiftKey || event.buttons & 6) this.camera.move(dx / this.height, dy / this.height);
    else if (this.travelled > CLICK_TRAVEL) this.camera.turn(dx / this.height, dy / this.height);
    this.down.set(event.pointerId, now);
    this.on.camera();
  }

  /** Move the scene with the middle of two fingers, and zoom with the distance between them. */
  pinch(pointer, before, now) {
    const [other] = [...this.down].filter(([id]) => id !== pointer).map(([, place]) => place);
    const apart = (place) => Math.max(Math.hypot(place.x - other.x, place.y - other.y), 1);
    this.camera.move((now.x - before.x) / 2 / this.height, (now.y - before.y) / 2 / this.height);
    this.camera.zoom(apart(before) / apart(now), ...this.fromTarget((now.x + other.x) / 2, (now.y + other.y) / 2));
  }

  release(event) {
    if (!this.down.delete(event.pointerId)) return;
    if (!this.down.size) this.canvas.classList.remove("moving");
    if (event.type === "pointercancel" || this.travelled > CLICK_TRAVEL || event.button) return;
    const { clientX: x, clientY: y, timeStamp: time } = event;
    const isDouble = time - this.last.time < DOUBLE_CLICK && Math.hypot(x - this.last.x, y - this.last.y) < 20;
    this.last = { time: isDouble ? 0 : time, x, y };
    this.on.click(x, y, isDouble);
  }

  wheel(event) {
    event.preventDefault();
    const pixels = event.deltaY * (event.deltaMode === 1 ? 33 : 1) * (event.ctrlKey ? 6 : 1);
    const factor = Math.exp(0.0014 * Math.min(Math.max(pixels, -300), 300));
    this.camera.zoom(factor, ...this.fromTarget(event.clientX, event.clientY));
    this.on.camera();
  }

  get height() {
    return this.canvas.clientHeight;
  }

  /** Return a position in the window relative to the camera's target, right and up, in fractions of the height. */
  fromTarget(x, y) {
    const [right, up] = this.camera.middle, width = this.canvas.clientWidth;
    return [(x - (width * (1 + right)) / 2) / this.height, ((this.height * (1 - up)) / 2 - y) / this.height];
  }
}

/** Listen to keys: `keys` is a list of [names of keys, description, function]. */
function listen(keys) {
  const lines = keys.flatMap(([names, words]) => [
    element("dt", { text: names.map((name) => (name === " " ? "space" : name)).join("  ") }),
    element("dd", { text: words }),
  ]);
  byId("key-list").replaceChildren(...lines);
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    if (event.target.closest("input[type=number], select")) return;
    const onControl = event.target.closest("button, input, summary");
    if (onControl && (event.key === " " || event.key === "Enter" || event.key.startsWith("Arrow"))) return;
    const pressed = event.key.length === 1 ? event.key.toUpperCase() : event.key;
    const found = keys.find(([names]) => names.includes(ARROWS[pressed] ?? pressed));
    if (!found) return;
    event.preventDefault();
    found[2](ARROWS[pressed] ?? pressed);
  });
}

const ARROWS = { ArrowLeft: "←", ArrowRight: "→", ArrowUp: "↑", ArrowDown: "↓", Escape: "escape", "=": "+" };
