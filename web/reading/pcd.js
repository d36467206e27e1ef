// Read point clouds in PCL's format: ascii, binary or binary_compressed, with columns in any order.

import { InputError, quoted } from "../errors.js";
import { checkPointCount, makeCloud, requireColumns } from "./cloud.js";
import { Header, readBinary, readColumn, readText, recordSize, TYPES, wholeOf } from "./fields.js";

const KIND = "a PCD file";
// LZF packs at most LONGEST_REPETITION bytes into a code of REPETITION_CODE bytes. No data can be packed more tightly.
const LONGEST_REPETITION = 264, REPETITION_CODE = 3;

/** Return the cloud in the bytes of a file; if a field has several values, only the first is read. */
export function readPcd(bytes, name) {
  const header = new Header(bytes, name, KIND, "line DATA"), entries = readEntries(header);
  const fields = fieldsOf(entries);
  const chosen = requireColumns(fields.map((field) => field.name), name);
  const points = entries.POINTS ? wholeOf(entries.POINTS[0]) : wholeOf(entries.WIDTH?.[0]) * wholeOf(entries.HEIGHT?.[0]);
  const start = header.position, encoding = (entries.DATA[0] ?? "").toLowerCase();

  if (encoding === "ascii") {
    // Each value takes at least one character, and another character separates two values.
    const values = fields.reduce((sum, { count }) => sum + count, 0);
    checkPointCount(points, name, bytes.length, 2 * values * points - 1);
    return makeCloud(readText(bytes, start, points, fields, chosen, name), name);
  }
  if (encoding === "binary") {
    checkPointCount(points, name, bytes.length, start + points * recordSize(fields));
    return makeCloud(readBinary(bytes, start, points, fields, chosen), name);
  }
  if (encoding === "binary_compressed") return makeCloud(readCompressed(bytes, start, points, fields, chosen, name), name);
  throw new InputError(
    `${name}: expected DATA ascii, binary, binary_compressed, found ${quoted(encoding, 20)}; write the file again`,
  );
}

/** Return the words of each line of the header, up to DATA, by the line's first word. */
function readEntries(header) {
  const entries = {};
  while (!entries.DATA) {
    const words = header.words();
    if (words.length && !words[0].startsWith("#")) entries[words[0].toUpperCase()] = words.slice(1);
  }
  return entries;
}

/** Return the fields that the lines FIELDS, SIZE, TYPE and COUNT describe. */
function fieldsOf(entries) {
  const names = entries.FIELDS ?? entries.COLUMNS ?? [], { TYPE: kinds = [], SIZE: sizes = [] } = entries;
  const counts = entries.COUNT?.map(wholeOf) ?? names.map(() => 1);
  const types = kinds.map((kind, place) => `${kind.toLowerCase()}${wholeOf(sizes[place])}`);
  const isWhole = [types, sizes, counts].every((list) => list.length === names.length);
  if (!isWhole || counts.some((count) => count < 0) || !types.every((type) => type in TYPES)) {
    throw new Error(`${names.length} FIELDS, TYPE and SIZE ${types.slice(0, 20)}, COUNT ${counts.slice(0, 20)}`);
  }
  return names.map((name, place) => ({ name, type: types[place], count: counts[place] }));
}

/** Read packed points. The data hold one field after the other; in each, the values of a point are side by side. */
function readCompressed(bytes, start, points, fields, chosen, name) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const packed = view.getUint32(start, true), size = view.getUint32(start + 4, true);
  checkPointCount(points, name, bytes.length, start + 8 + packed);
  const expected = points * recordSize(fields);
  if (size !== expected || size * REPETITION_CODE > packed * LONGEST_REPETITION) {
    throw new InputError(`${name}: expected ${expected} bytes of points, found ${size}; write the file again`);
  }

  const data = unpackLzf(bytes.subarray(start + 8, start + 8 + packed), size), columns = {};
  for (const [key, index] of Object.entries(chosen)) {
    const { type, count } = fields[index];
    columns[key] = readColumn(data, points * recordSize(fields.slice(0, index)), TYPES[type][0] * count, points, type);
  }
  return columns;
}

/** Unpack `size` bytes of LZF. */
function unpackLzf(data, size) {
  const output = new Uint8Array(size);
  let filled = 0, position = 0;
  while (position < data.length && filled < size) {
    const control = data[position++];
    if (control < 32) {  // a literal: the next control + 1 bytes are copied
      output.set(data.subarray(position, position + control + 1), filled);
      filled += control + 1;
      position += control + 1;
      continue;
    }

    // A back reference has 3 bits of length and 13 bits of distance. If all 3 bits are set, a byte to add follows.
    let length = (control >> 5) + 2;
    if (length === 9) length += data[position++];
    let from = filled - (((control & 31) << 8) + data[position++] + 1);
    if (!(from >= 0 && filled + length <= size)) throw new Error("a repetition of bytes that are not there");
    for (; length > 0; length--) output[filled++] = output[from++];  // it may repeat what it writes
  }
  if (filled !== size || position !== data.length) throw new Error(`${filled} bytes of points, ${size} expected`);
  return output;
}
