// Compare the two networks (section 3.2 of the paper), and merge their probabilities f and g (n K) (section 3.3).

const TINY = 1e-12;  // the least divisor, which keeps quotients finite

/** Return the cosine similarity (n) of the networks' probabilities. */
export function similarityOf(f, g, k) {
  const similarity = new Float32Array(f.length / k);
  for (let i = 0; i < similarity.length; i++) {
    let ff = 0, gg = 0, fg = 0;
    for (let place = i * k; place < (i + 1) * k; place++) {
      ff += f[place] * f[place];
      gg += g[place] * g[place];
      fg += f[place] * g[place];
    }
    similarity[i] = Math.min(fg / Math.sqrt(Math.max(ff * gg, TINY)), 1);
  }
  return similarity;
}

/** Return the geometric mean (n K) of the networks' probabilities. */
export function geometricMean(f, g) {
  return f.map((value, place) => Math.sqrt(value * g[place]));
}

/** Return the mean (n K), in which the uncertain points (u) have the probabilities of the head (u K). */
export function merged(mean, uncertain, head, k) {
  const scores = mean.slice();
  uncertain.forEach((i, row) => scores.set(head.subarray(row * k, (row + 1) * k), i * k));
  return scores;
}

/** Return the id (n) of the most probable class, 1 to K. */
export function labelsOf(scores, k) {
  const labels = new Uint8Array(scores.length / k);
  for (let i = 0; i < labels.length; i++) {
    let best = i * k;
    for (let place = best + 1; place < (i + 1) * k; place++) if (scores[place] > scores[best]) best = place;
    labels[i] = best - i * k + 1;
  }
  return labels;
}
