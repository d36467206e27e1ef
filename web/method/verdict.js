// Judge how sure the labels of a scan are, as the command `predict` does.

const FEW_UNCERTAIN = 0.01;  // the share below which labels are not doubtful
const SMALLEST = 1e-12;  // the probability whose logarithm stands for that of 0

/**
 * Return {isDoubtful, text} on what `segment` returned for a scan, or null if the weights do not say what is usual.
 *
 * With two networks, the share of uncertain points counts; with one, the mean entropy of its probabilities (n K).
 */
export function verdictOf({ scores, uncertain }, { method, doubt }, k) {
  if (!doubt) return null;
  const share = uncertain ? meanOf(uncertain) : k * meanOf(scores[method], (p) => -p * Math.log(Math.max(p, SMALLEST))) / Math.log(Math.max(k, 2));
  const { usual, unusual_odds: odds } = doubt, percent = (value) => `${(100 * value).toFixed(1)}%`;
  const isDoubtful = share >= FEW_UNCERTAIN && share * (1 - usual) > odds * usual * (1 - share);
  const what = uncertain ? "of the points are uncertain" : "is the mean entropy of the network";
  const text = `${percent(share)} ${what} (usual: ${percent(usual)})`;
  return { isDoubtful, text: isDoubtful ? `do not rely on these labels: ${text}` : text };
}

function meanOf(values, of = (value) => value) {
  let sum = 0;
  for (const value of values) sum += of(value);
  return sum / Math.max(values.length, 1);
}
