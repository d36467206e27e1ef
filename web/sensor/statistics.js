// NumPy's quantiles, interpolation and random numbers, so that scans are normalised exactly as `amvnet predict` does.

/** Return the quantiles of ascending values at probabilities in [0, 1]. */
export function quantilesOf(ascending, probabilities) {
  return probabilities.map((probability) => {
    const place = probability * (ascending.length - 1), low = Math.floor(place), share = place - low;
    const a = ascending[low], b = ascending[Math.min(low + 1, ascending.length - 1)];
    return a + (b - a) * share;
  });
}

/** Interpolate linearly between points (from, to) with ascending `from`; beyond an end, return its value. */
export function interpolate(value, from, to) {
  if (value <= from[0]) return to[0];
  for (let i = 1; i < from.length; i++) {
    if (value < from[i]) return to[i - 1] + ((value - from[i - 1]) * (to[i] - to[i - 1])) / (from[i] - from[i - 1]);
  }
  return to.at(-1);
}

const MULTIPLIER = 0x2360ed051fc65da44385df649fccf645n, BITS = (1n << 128n) - 1n;

/** Return a function that returns the random numbers of NumPy's `default_rng(0)` (PCG64), in [0, 1). */
export function seededRandom() {
  // The increment and the first state of seed 0.
  const increment = 0x418ddadb3af71a82588133bc447873a9n;
  let state = 0x1aa1b5345996452d09585eb7a69561e3n;
  return () => {
    state = (state * MULTIPLIER + increment) & BITS;
    const mixed = BigInt.asUintN(64, (state >> 64n) ^ state), turn = state >> 122n;
    const drawn = BigInt.asUintN(64, (mixed >> turn) | (mixed << (64n - turn)));
    return Number(drawn >> 11n) / 2 ** 53;
  };
}
