// A camera that orbits a point; z is up, lengths are in metres, matrices are column-major.
"use strict";

const FIELD = Math.tan((25 * Math.PI) / 180);  // half the height of the field of view at a distance of 1
const NEAREST = 0.5, FARTHEST = 1500;  // the limits of the distance from the camera to its target, metres
const LOWEST = 0.03;  // the least elevation of the camera, which keeps it above the ground, radians
// The angles of a drag over the window's height, radians. From the view FIRST, a drag over a third of the height tilts
// the camera down to the ground.
const TURN = Math.PI, TILT = Math.PI / 2;
// Views: the position of the camera around its target, in radians and metres.
const FIRST = { azimuth: 3.6, elevation: 0.55, distance: 46, target: [4, 0, -1] };
const ABOVE = { azimuth: Math.PI, elevation: Math.PI / 2, distance: 95, target: [0, 0, 0] };
const STREET = { azimuth: Math.PI, elevation: 0.2, distance: 14, target: [6, 0, -0.5] };

class Camera {
  constructor() {
    this.middle = [0, 0];  // the place of the target on the screen, in clip space; the panel does not cover it
    this.set(FIRST);
  }

  set({ azimuth, elevation, distance, target }) {
    Object.assign(this, { azimuth, elevation, distance, target: [...target] });
    this.clamp();
  }

  clamp() {
    this.azimuth = ((this.azimuth % (2 * Math.PI)) + 2 * Math.PI) % (2 * Math.PI);
    this.elevation = Math.min(Math.max(this.elevation, LOWEST), Math.PI / 2);
    this.distance = Math.min(Math.max(this.distance, NEAREST), FARTHEST);
    this.target = this.target.map((value) => Math.min(Math.max(value, -FARTHEST), FARTHEST));
  }

  /** Return unit vectors to the right, up and towards the camera. */
  axes() {
    const ca = Math.cos(this.azimuth), sa = Math.sin(this.azimuth);
    const ce = Math.cos(this.elevation), se = Math.sin(this.elevation);
    return { right: [-sa, ca, 0], up: [-se * ca, -se * sa, ce], back: [ce * ca, ce * sa, se] };
  }

  get near() {
    return Math.max(0.05, this.distance / 200);
  }

  get far() {
    return this.distance + FARTHEST;
  }

  /** Return the (4, 4) matrix from metres to clip space, as 16 numbers. */
  matrix(aspect) {
    const { right, up, back } = this.axes();
    const eye = this.target.map((value, axis) => value + this.distance * back[axis]);
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const rows = [right, up, back].map((axis) => [...axis, -dot(axis, eye)]);
    const depth = (this.near + this.far) / (this.near - this.far);
    const shift = (2 * this.near * this.far) / (this.near - this.far);
    const out = new Float32Array(16);
    for (let column = 0; column < 4; column++) {
      const w = -rows[2][column];
      out[4 * column] = rows[0][column] / (FIELD * aspect) + this.middle[0] * w;
      out[4 * column + 1] = rows[1][column] / FIELD + this.middle[1] * w;
      out[4 * column + 2] = -w * depth + (column === 3 ? shift : 0);
      out[4 * column + 3] = w;
    }
    return out;
  }

  /** Turn the camera around its target; dx and dy are fractions of the window's height. */
  turn(dx, dy) {
    this.azimuth -= TURN * dx;
    this.elevation += TILT * dy;
    this.clamp();
  }

  /** Move the scene along the screen; dx and dy are fractions of the window's height. */
  move(dx, dy) {
    const { right, up } = this.axes(), metres = 2 * FIELD * this.distance;
    this.target = this.target.map((value, axis) => value + metres * (dy * up[axis] - dx * right[axis]));
    this.clamp();
  }

  /**
   * Multiply the distance by a factor. The point at (x, y) relative to the target stays in place; x and y are fractions
   * of the window's height, to the right and up.
   */
  zoom(factor, x = 0, y = 0) {
    const before = this.distance;
    this.distance *= factor;
    this.clamp();
    const { right, up } = this.axes(), metres = 2 * FIELD * (before - this.distance);
    this.target = this.target.map((value, axis) => value + metres * (x * right[axis] + y * up[axis]));
    this.clamp();
  }
}
