// Write labels as files, as `amvnet predict` does: an id of the benchmark for each point, in the order of the scan.

/** Return the uint32 ids (n) of a benchmark's files for all points, given the labels and places of the valid points. */
export function rawIds(labels, places, total, classes) {
  const raw = new Uint32Array(total).fill(classes[0].raw_id);
  labels.forEach((label, i) => (raw[places[i]] = classes[label].raw_id));
  return raw;
}

/** Return the parts of a file of ids; `kind` is `label` (only the ids) or `npy` (NumPy's format 1.0). */
export function partsOf(kind, ids) {
  if (kind === "label") return [ids];
  const text = `{'descr': '<u4', 'fortran_order': False, 'shape': (${ids.length},), }`;
  const length = Math.ceil((10 + text.length + 1) / 64) * 64 - 10;  // the values begin at a multiple of 64 bytes
  const header = `${text.padEnd(length - 1)}\n`;
  return [Uint8Array.of(0x93, 0x4e, 0x55, 0x4d, 0x50, 0x59, 1, 0, length & 255, length >> 8), header, ids];
}

/** Offer a file to the user. */
export function save(name, parts) {
  const url = URL.createObjectURL(new Blob(parts));
  Object.assign(document.createElement("a"), { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}
