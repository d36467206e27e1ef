// Find the point that was clicked, and show its classes and values.
"use strict";

const CLICK_RADIUS = 9;  // the largest distance from the pointer to a point that it clicks, pixels

/** Return the index of the drawn point that is clicked at (x, y) in the window; -1 if there is none. */
function pointAt(x, y, scan, look, matrix, width, height) {
  const shown = shownBy(look, scan), { center, step, positions } = scan;
  let best = -1, least = Infinity;
  for (let i = 0; i < scan.count; i++) {
    const p = [0, 1, 2].map((axis) => center[axis] + step[axis] * positions[3 * i + axis]);
    const [u, v, , w] = projected(p, matrix);
    if (w <= 0) continue;
    const off = Math.hypot(((u / w + 1) / 2) * width - x, ((1 - v / w) / 2) * height - y);
    const cost = w * (1 + off);  // prefers near points, then points close to the pointer
    if (off < CLICK_RADIUS && cost < least && shown(i)) [best, least] = [i, cost];
  }
  return best;
}

function projected([x, y, z], m) {
  return [0, 1, 2, 3].map((r) => m[r] * x + m[4 + r] * y + m[8 + r] * z + m[12 + r]);
}

/** Show a point's classes and values on the card. */
function describe(i, scan) {
  const { planes } = scan, [x, y, z] = placeOf(scan, i), lines = [];
  const truth = planes.truth ? planes.truth[i] : 0;
  for (const { key, title } of about.sources) {
    if (!planes[key]) continue;
    const id = planes[key][i];
    const wrong = truth > 0 && key !== "truth" && id !== truth;
    const text = element("span", { name: wrong ? "wrong" : "", text: about.classes[id] + (wrong ? " ✗" : "") });
    const probability = planes[`${key}-probability`];
    const certainty = probability ? [element("span", { name: "value", text: ` ${probability[i]} %` })] : [];
    lines.push([title, swatch(about.colors[id]), text, ...certainty]);
  }
  if (planes["second-probability"]?.[i]) {
    const id = planes.second[i], text = `${about.classes[id]} `;
    const certainty = element("span", { name: "value", text: `${planes["second-probability"][i]} %` });
    lines.push(["second", swatch(about.colors[id]), element("span", { text }), certainty]);
  }
  if (planes.disagreement) {
    const doubt = planes.uncertain[i] ? ", uncertain" : "";
    lines.push(["disagreement", `${(planes.disagreement[i] / 255).toFixed(2)}${doubt}`]);
  }
  const inFile = [x, y, z].map((value, axis) => (value + (scan.origin?.[axis] ?? 0)).toFixed(2));
  lines.push(["x, y, z", `${inFile.join(", ")} m`]);
  lines.push(["distance", `${Math.hypot(x, y, z).toFixed(1)} m`]);
  lines.push(["intensity", (planes.intensity[i] / 255).toFixed(2)]);
  const rows = lines.map(([name, ...found]) =>
    element("tr", { children: [element("th", { text: name }), element("td", { children: found })] }));
  byId("point").querySelector("table").replaceChildren(...rows);
}
