// Takes the place of the viewer's scans.js in viewer.html: the scan comes from the page around this frame.
"use strict";

const about = aboutOf(JSON.parse(document.getElementById("about").textContent), parent.shown.about);

/** Add the colours of drawings to what is known of the scan. */
function aboutOf({ unlabelled, drawn, ...drawing }, shown) {
  const colors = shown.official.map(({ name, color }) => drawn[shown.taxonomy]?.[name] ?? color);
  return { ...drawing, ...shown, colors: [unlabelled, ...colors.slice(1)] };
}

/** Return a promise of the scan: {name, count, center, step, positions, planes: {intensity, rv, ...}}. */
async function scanAt() {
  return parent.shown.scan;
}

/** Return [x, y, z] of a point, in metres in the sensor's frame. */
function placeOf(scan, i) {
  return [0, 1, 2].map((axis) => scan.center[axis] + scan.step[axis] * scan.positions[3 * i + axis]);
}
