// Read an array of points from a file of NumPy.

import { InputError, quoted } from "../errors.js";
import { checkPointCount, makeCloud, ringIndices } from "./cloud.js";
import { readColumn, TYPES } from "./fields.js";
import { areRings, COLUMNS } from "./raw.js";

const EXPECTED = "expected an array (N, 3), (N, 4) or (N, 5) of x, y, z, intensity and ring, found";
const ADVICE = "save such an array with np.save, or label it with amvnet predict";
const TRANSPOSED_ROWS = 10;  // an array with at most so many rows and more columns is transposed
// The header that NumPy writes for an array of numbers with two axes. It is matched and never evaluated.
const HEADER = /^\{'descr': '([<>|])(f[48]|[iu][1248])', 'fortran_order': (True|False), 'shape': \((\d+), ([345])\), \}\s*$/;

/** Return the cloud of an array with a row for each point. */
export function readNpy(bytes, name) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const [begin, length] = bytes[6] === 1 ? [10, view.getUint16(8, true)] : [12, view.getUint32(8, true)];
  const start = begin + length, header = new TextDecoder("latin1").decode(bytes.subarray(begin, start));
  const match = HEADER.exec(header);
  const shape = /'shape': \((\d+(?:, \d+){1,2})\)/.exec(header)?.[1].split(", ").map(Number) ?? [];
  if (shape.at(-1) > TRANSPOSED_ROWS && shape[0] <= TRANSPOSED_ROWS) {
    throw new InputError(`${name}: expected a row per point, found shape (${shape.join(", ")}), which is transposed; `
      + "save numpy.moveaxis(array, 0, -1)");
  }
  if (!match) throw new InputError(`${name}: ${EXPECTED} ${quoted(header.trim(), 80)}; ${ADVICE}`);

  const [, order, type, isFortran] = match, [count, width] = shape, size = TYPES[type][0];
  checkPointCount(count, name, bytes.length, start + count * width * size);
  const [step, stride] = isFortran === "True" ? [count * size, size] : [size, width * size];
  const columns = Object.fromEntries(COLUMNS.slice(0, width).map((key, place) => {
    return [key, readColumn(bytes, start + place * step, stride, count, type, order !== ">")];
  }));
  if (columns.ring) {
    const ring = ringIndices(columns.ring.values), axes = [columns.x, columns.y, columns.z].map(({ values }) => values);
    if (!ring || !areRings(...axes, ring)) {
      throw new InputError(`${name}: ${EXPECTED} other numbers in the fifth column; ${ADVICE}`);
    }
  }
  return makeCloud(columns, name);
}
