// AMVNet, step by step as in the paper: project, score twice, compare, classify the disputed points, merge.

import { disputedOf, firstInCubes, geometricMean, labelsOf, merged, similarityOf } from "./fusion.js";
import { classify } from "./head.js";
import { nearestOthers } from "./neighbours.js";
import { polarGrid } from "./polar_view.js";
import { rangeImage } from "./range_view.js";

/**
 * Segment a normalised scan {points, rows}. `step(title, work)` runs one step and returns what it returns.
 *
 * Returns {scores, labels, similarity, uncertain}: by method (`rv`, `bev`, `ensemble`, `amvnet`) the probabilities
 * (n K) and the ids (n) of the classes, 1 to K; with two networks also their similarity (n) and whether a point is
 * uncertain (n).
 */
export async function segment(networks, { points, rows }, step) {
  const { description, k } = networks, { method } = description, scores = {};

  if (method !== "bev") {
    const image = await step("project to the range image", () => rangeImage(description.range_view, points, rows));
    scores.rv = await step("range-view network", () => networks.scoreRangeView(image, points));
  }
  if (method !== "rv") {
    const grid = await step("project to the polar grid", () => polarGrid(description.polar_view, points));
    scores.bev = await step("bird's-eye-view network", () => networks.scorePolarView(grid));
  }
  if (method === "rv" || method === "bev") return { scores, labels: labelsOfAll(scores, k) };

  const { rv: f, bev: g } = scores;
  const similarity = await step("compare", () => similarityOf(f, g, k));
  const { lead, threshold } = description.assertion, tau = Math.fround(threshold);
  const uncertain = Uint8Array.from(similarity, (value) => value <= tau);
  scores.ensemble = await step("mean of both", () => geometricMean(f, g));

  if (method === "amvnet") {
    const disputed = disputedOf(f, g, k, uncertain, lead), { neighbours: n, cell } = description.point_head;
    const [index, cube] = firstInCubes(points, disputed, cell);
    const neighbours = await step("neighbours", () => (index.length ? nearestOthers(points, index, n) : index));
    const head = await step("point head", () => classify(networks, { points, f, g, disputed: index, neighbours }));
    scores.amvnet = await step("merge", () => merged(scores.ensemble, disputed, head, cube, k));
  }
  return { scores, labels: labelsOfAll(scores, k), similarity, uncertain };
}

function labelsOfAll(scores, k) {
  return Object.fromEntries(Object.entries(scores).map(([method, values]) => [method, labelsOf(values, k)]));
}
