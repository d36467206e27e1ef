// In viewer.html, this takes the place of src/amvnet/viewing/page_assets/scans.js, and has its names. The page around
// this frame has one scan in `shown`, which is {about, scan} of shown.js.
"use strict";

const about = aboutOf(JSON.parse(document.getElementById("about").textContent), parent.shown.about);

/**
 * Return what the viewer needs to know: how it draws, which viewer.html holds, and what shown.js says of the scan.
 *
 * Classes have the colours of pages (`drawn`, by the name of the taxonomy), or else those of label files (`official`).
 */
function aboutOf({ unlabelled, drawn, ...drawing }, ofScan) {
  const colors = ofScan.official.map(({ name, color }) => drawn[ofScan.taxonomy]?.[name] ?? color);
  return { ...drawing, ...ofScan, colors: [unlabelled, ...colors.slice(1)] };
}

/** Return a promise of the only scan: {name, count, center, step, positions, planes: {intensity, rv, ...}}. */
async function scanAt() {
  return parent.shown.scan;
}

/** Return [x, y, z] of a point in the sensor's frame, metres. */
function placeOf(scan, i) {
  return [0, 1, 2].map((axis) => scan.center[axis] + scan.step[axis] * scan.positions[3 * i + axis]);
}
