// Normalise a scan of any sensor to what the weights expect: axes, height, intensities, rows.

import { InputError } from "../errors.js";
import { isPlaced } from "../reading/cloud.js";
import { findFrame, isOnGround, risesOf, tilted, toLevel, UNITS } from "./frame.js";
import { MIN_DISTANCE } from "./ground.js";
import { fillIntensity, intensityMap, matchIntensity, missingText, negativeText } from "./intensity.js";
import { ANY, elevationOf, hasEndsOf, orderRings, rowsOf } from "./rows.js";
import { quantilesOf } from "./statistics.js";

const FARTHEST = 10_000;  // the limit of coordinates, metres; no LiDAR sees so far
const MIN_POINTS = 100;  // the least number of points on which a sensor is measured
const LEAST_OWN = 0.15;  // the least share of a scan's points that shows the body of the car
const QUICK_STEP = 7;  // the step between the points that show the lasers of such a scan
// The body of nuScenes' car in the frame of its files, metres, and the field of view of its sensor.
const BODY = { low: [-0.71, -1.18, -0.93], high: [0.71, 2.07, 0.01], sensor: { beams: 32, fov_up: 10.67, fov_down: -30.67 } };
const SAME_BEAMS = 1.4;  // the largest ratio of two numbers of lasers that are alike
const OWN_ANGLE = 3;  // the largest difference of the ends of the field of view of weights' own sensor, degrees

/**
 * Return {points, rows, places, text, isMadeFor}. The valid points are normalised (4 n: x, y, z in metres, intensity in
 * [0, 1]). With them come their rows in the range image, or null, their places in the cloud, a line on what was assumed,
 * and whether the weights are made for such lasers, or null if they do not say for which.
 *
 * `expected` describes the scans that the weights know: {view, sensor, intensity, as_is}.
 */
export function normalise(cloud, expected) {
  const { name, xyz, count } = cloud, { sensor } = expected;
  const usable = xyz.filter((_, place) => isPlaced(xyz, place - (place % 3)));
  const frame = findFrame(usable, name);
  const [toSensor, toTrained] = risesOf(frame, sensor.height);

  const level = toLevel(xyz, frame), map = intensityMap(cloud, expected.intensity), intensity = map.apply();
  const { points, places } = validPoints(level, intensity, name), seen = raised(points, toSensor);
  const { ring, fault } = orderRings(seen, cloud.ring && Uint8Array.from(places, (place) => cloud.ring[place]));
  const lasers = lasersOf(seen, ring);
  const rows = rowsOf(seen, tilted(seen, frame), ring, lasers, expected);

  fillIntensity(points);
  const kept = withoutOwn(raised(points, toTrained), rows, places, cloud, frame.unit);
  matchIntensity(kept.points, expected.intensity);
  const texts = [map.text, missingText(cloud), negativeText(cloud), ...frameTexts(frame)];
  texts.push(heightText(frame, sensor.height), fault, lasersText(lasers));
  const isLike = isLikeOf(lasers, sensor), text = `assumed ${texts.filter(Boolean).join(", ")}`;
  const isMadeFor = isLikeOf(lasers, sensor, OWN_ANGLE);
  return { count, ...kept, text: isLike === false ? text + strangeText(sensor) : text, isMadeFor };
}

/** Return the points (4 n, float32) at finite coordinates that are not the origin, and their places in the cloud. */
function validPoints(xyz, intensity, name) {
  const count = xyz.length / 3, points = new Float32Array(4 * count), places = new Uint32Array(count);
  let filled = 0, isFar = false;
  for (let i = 0; i < count; i++) {
    const [x, y, z] = [0, 1, 2].map((axis) => Math.fround(xyz[3 * i + axis]));
    if (!(x || y || z)) continue;
    const isNear = Math.abs(x) < FARTHEST && Math.abs(y) < FARTHEST && Math.abs(z) < FARTHEST;
    isFar ||= !isNear && Number.isFinite(x + y + z);
    if (!isNear) continue;
    points.set([x, y, z, intensity[i]], 4 * filled);
    places[filled++] = i;
  }
  if (!filled) throw new InputError(`${name}: ${whyUnusable(count, isFar)}`);
  return { points: points.subarray(0, 4 * filled), places: places.subarray(0, filled) };
}

/**
 * Return {points, rows, places} of the points outside the car's own body, if the scan shows a body that is known:
 * nuScenes' car, which has many points of every scan.
 */
function withoutOwn(points, rows, places, { xyz, ring, count }, unit) {
  const pointAt = (place) => [...xyz.subarray(3 * place, 3 * place + 3).map((value) => value * UNITS[unit])];
  const isOwn = (place) => pointAt(place).every((value, axis) => value >= BODY.low[axis] && value <= BODY.high[axis]);
  const kept = Uint32Array.from(places.keys()).filter((i) => !isOwn(places[i]));
  if ((places.length - kept.length) / count < LEAST_OWN) return { points, rows, places };
  const part = places.filter((place) => place % QUICK_STEP === 0), inFile = [...part].flatMap((place) => [...pointAt(place), 0]);
  const lasers = lasersOf(Float64Array.from(inFile), ring && part.map((place) => ring[place]));
  if (lasers.fov_up === null || !isLikeOf(lasers, BODY.sensor)) return { points, rows, places };
  const result = new Float32Array(4 * kept.length);
  kept.forEach((i, row) => result.set(points.subarray(4 * i, 4 * i + 4), 4 * row));
  return { points: result, rows: rows && Int32Array.from(kept, (i) => rows[i]), places: kept.map((i) => places[i]) };
}

function whyUnusable(count, isFar) {
  if (!count) return "expected a scan with points, found 0 points; leave the file out";
  if (isFar) {
    return (
      `expected metres from the sensor, found points farther than ${FARTHEST / 1000} km, as in map coordinates; ` +
      "label it with amvnet predict, and subtract the sensor's position x,y,z with --offset -x,-y,-z"
    );
  }
  return "expected finite coordinates, found NaN, infinity or 0, 0, 0 in every point; leave the file out";
}

/** Return points (4 n) moved up by some metres, in float32. */
function raised(points, rise) {
  const result = points.slice();
  for (let i = 2; i < result.length; i += 4) result[i] += Math.fround(rise);
  return result;
}

/** Measure the lasers of a sensor: {beams, fov_up, fov_down}; null stands for what is unknown. */
function lasersOf(seen, ring) {
  const elevations = [];
  for (let i = 0; i < seen.length; i += 4) {
    const [x, y, z] = seen.subarray(i, i + 3);
    if (Math.hypot(x, y) > MIN_DISTANCE) elevations.push(elevationOf(x, y, z));
  }
  if (elevations.length < MIN_POINTS) return { beams: null, fov_up: null, fov_down: null };
  const [bottom, top] = quantilesOf(Float64Array.from(elevations).sort(), [0.005, 0.995]);
  const beams = ring ? new Set(ring).size : null;
  return { beams, fov_up: top, fov_down: bottom };
}

const signed = (value, digits) => `${value < 0 ? "" : "+"}${value.toFixed(digits)}`;

function frameTexts({ unit, axes, pitch, roll, tilt }) {
  const texts = [];
  if (unit !== "m") texts.push(`--unit ${unit}`);
  if (axes !== "x-forward") texts.push(`--axes ${axes}`);
  if (pitch || roll) {
    const turn = `0,${pitch.toFixed(1)},${roll.toFixed(1)}`;
    texts.push(`a tilt of ${tilt.toFixed(0)} degrees (levelled, --rotate ${turn})`);
  }
  return texts;
}

function heightText(frame, usualHeight) {
  const { height } = frame;
  if (height === null) return "no ground to measure the height by (give --height; --axes if z is not up)";
  const [, rise] = risesOf(frame, usualHeight), notes = rise ? [`moved by ${signed(rise, 2)} m to ${usualHeight.toFixed(2)} m`] : [];
  let text = `sensor ${height.toFixed(2)} m over the ground`;
  if (isOnGround(frame)) {
    text = `the ground at ${signed(-height, 2)} m, so the origin is not the sensor`;
    notes.push("--offset 0,0,-Z if the sensor is Z m over the origin");
  }
  return notes.length ? `${text} (${notes.join("; ")})` : text;
}

function lasersText({ beams, fov_up: top, fov_down: bottom }) {
  const count = beams === null ? "lasers" : `${beams} lasers`;
  if (top === null) return beams === null ? "field of view not found" : count;
  return `${count} from ${signed(top, 0)} to ${signed(bottom, 0)} degrees`;
}

/** Return whether lasers are like those of a sensor; null if its field of view is not known. */
function isLikeOf(lasers, sensor, angle) {
  if (sensor.name === ANY) return true;
  if (sensor.fov_up === null || sensor.fov_down === null) return null;
  const ratio = lasers.beams && sensor.beams ? lasers.beams / sensor.beams : 1;
  return ratio > 1 / SAME_BEAMS && ratio < SAME_BEAMS && hasEndsOf(lasers, sensor, angle);
}

/** Return the end of the line that says which sensor the weights have seen instead. */
function strangeText(sensor) {
  const name = sensor.name || "a sensor";
  return `; the weights were trained for ${name} (${lasersText(sensor)}) and have seen no such sensor`;
}
