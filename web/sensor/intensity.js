// Bring intensities to the range and the distribution that the weights know. All decisions rest on quantiles, so that a
// few outliers change nothing.

import { counted } from "../errors.js";
import { measuredIntensities } from "../reading/cloud.js";
import { interpolate, quantilesOf, seededRandom } from "./statistics.js";

// The quantiles at these probabilities describe a distribution of intensities.
const PROBABILITIES = [0.001, 0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99, 0.999];
const MEDIAN = PROBABILITIES.indexOf(0.5), BRIGHT = PROBABILITIES.indexOf(0.9);
const DARKEST_INTENSITY = 0.004;  // the least intensity in a comparison, one step of 8 bits
const ALIKE_FACTOR = 2;  // the largest ratio of the medians, or of the bright quantiles, of two similar distributions
// The largest range of 98 % of the intensities, as a share of the median, with which they are constant.
const CONSTANT_SHARE = 0.01;

/** Return whether nearly all intensities are the same. */
function isConstant(quantiles) {
  const [low, high] = [0.01, 0.99].map((probability) => quantiles[PROBABILITIES.indexOf(probability)]);
  return high - low <= CONSTANT_SHARE * Math.abs(quantiles[MEDIAN]);
}

/** Return a function that maps intensities with these quantiles to the distribution of the training. */
function matching(quantiles, trained) {
  // Equal quantiles, as of many zeros, become the mean of the training's quantiles in their place.
  const levels = [...new Set(quantiles)];
  const becomes = levels.map((level) => {
    const same = trained.filter((_, place) => quantiles[place] === level);
    return Math.min(Math.max(same.reduce((sum, value) => sum + value, 0) / same.length, 0), 1);
  });
  return (value) => interpolate(value, levels, becomes);
}

/**
 * Return {text, apply}: what is done with the intensities of a cloud, and a function that returns those in [0, 1].
 * `trained` says what the weights know: {quantiles, is_optional, is_matched}, or null.
 */
export function intensityMap(cloud, trained) {
  const { intensity, count } = cloud, { measured } = measuredIntensities(cloud);
  const quantiles = quantilesOf(measured, PROBABILITIES), fill = () => filler(count, trained);
  if (!measured.length) return { text: `no intensity (${fillerText(trained)})`, apply: fill };
  if (isConstant(quantiles)) {
    const level = Number(quantiles[MEDIAN].toPrecision(6));
    return { text: `intensity ${level} everywhere, so none (${fillerText(trained)})`, apply: fill };
  }

  const scale = usualScale(quantiles.at(-1), intensity.isInteger), { values } = intensity;
  const rounded = values instanceof Float32Array ? Math.fround : (value) => value;
  const divided = (value) => (Number.isFinite(value) ? Math.min(Math.max(rounded(value / scale), 0), 1) : NaN);
  const linear = { text: `intensity 0 to ${Number(scale.toPrecision(6))}`, apply: () => Float32Array.from(values, divided) };
  if (trained?.is_matched) return { ...linear, text: `${linear.text}, spread as in the training` };  // by matchIntensity
  if (!trained || areAlike(quantiles.map((value) => value / scale), trained.quantiles)) return linear;

  const matched = matching(quantiles, trained.quantiles);
  const [half, now] = [quantiles[MEDIAN] / scale, trained.quantiles[MEDIAN]].map((value) => Number(value.toPrecision(2)));
  return {
    text: `${linear.text}, spread as in the training: half of it was below ${half}, now ${now} ` +
      `(--intensity-scale ${Number(scale.toPrecision(6))} keeps it)`,
    apply: () => Float32Array.from(values, (value) => (Number.isFinite(value) ? matched(value) : NaN)),
  };
}

/** Describe how many points have no intensity although others have; empty if none. */
export function missingText(cloud) {
  const { measured, placed } = measuredIntensities(cloud), missing = placed - measured.length;
  return measured.length && missing ? `no intensity in ${counted(missing)} of ${counted(placed)} points (the median instead)` : "";
}

/** Replace the missing intensities of points (4 n) by the median of the others, in place. */
export function fillIntensity(points) {
  const known = points.filter((value, place) => place % 4 === 3 && Number.isFinite(value)).sort();
  const [median] = quantilesOf(known, [0.5]);
  for (let i = 3; i < points.length; i += 4) if (!Number.isFinite(points[i])) points[i] = median;
}

/** Describe how many points have an intensity below 0, which counts as 0; empty if none or all have it. */
export function negativeText(cloud) {
  const { measured } = measuredIntensities(cloud), below = measured.findIndex((value) => value >= 0);
  if (below <= 0) return "";
  const lowest = Number(measured[0].toPrecision(6));
  return `intensity ${lowest} in ${counted(below)} of ${counted(measured.length)} points (0 instead)`;
}

/** Bring the intensities of points (4 n) to the distribution of the training, in place, if `trained` asks for it. */
export function matchIntensity(points, trained) {
  if (!trained?.is_matched) return;
  const quantiles = quantilesOf(points.filter((_, place) => place % 4 === 3).sort(), PROBABILITIES);
  if (isConstant(quantiles)) return;
  const matched = matching(quantiles, trained.quantiles);
  for (let i = 3; i < points.length; i += 4) points[i] = matched(points[i]);
}

/** Return the end of the narrowest usual range of intensities that holds `largest`. */
function usualScale(largest, isInteger) {
  const ranges = isInteger ? [255, 65535] : [1, 255, 65535];  // integers are not fractions
  return ranges.find((limit) => largest <= limit) ?? largest;
}

function areAlike(a, b) {
  const least = DARKEST_INTENSITY;
  return [MEDIAN, BRIGHT].every((place) => {
    const [low, high] = [Math.max(a[place], least), Math.max(b[place], least)].sort((x, y) => x - y);
    return high <= ALIKE_FACTOR * low;
  });
}

/** Return intensities for a scan that has none: zeros for networks that do not need them, else seeded random ones. */
function filler(count, trained) {
  if (!trained || trained.is_optional) return new Float32Array(count);
  const draw = seededRandom();
  return Float32Array.from({ length: count }, () => interpolate(draw(), PROBABILITIES, trained.quantiles));
}

function fillerText(trained) {
  if (!trained) return "0 instead";
  if (trained.is_optional) return "0 instead, as in a part of the training";
  return "drawn at random as in the training; the labels will be much worse";
}
