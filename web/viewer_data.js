// This replaces the viewer's scans.js in viewer.html. The scan comes from the page around this frame.
"use strict";

const about = aboutOf(JSON.parse(document.getElementById("about").textContent), parent.shown.about);

/** Return what the viewer needs to know: the values of the scan, with the colours of drawings. */
function aboutOf({ unlabelled, drawn, ...drawing }, shown) {
  const colors = shown.official.map(({ name, color }) => drawn[shown.taxonomy]?.[name] ?? color);
  return { ...drawing, ...shown, colors: [unlabelled, ...colors.slice(1)] };
}

/** Return a promise of the scan: {name, count, center, step, positions, planes: {intensity, rv, ...}}. */
async function scanAt() {
  return parent.shown.scan;
}

/** Return [x, y, z] of a point in the sensor's frame, metres. */
function placeOf(scan, i) {
  return [0, 1, 2].map((axis) => scan.center[axis] + scan.step[axis] * scan.positions[3 * i + axis]);
}
