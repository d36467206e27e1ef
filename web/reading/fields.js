// Read records of numbers with named fields from PCD and PLY files, in text or in binary.
//
// A field is {name, type, count}: its type is one of TYPES, and it has `count` values in a record.

import { InputError } from "../errors.js";

const HEADER = 65_536;  // the longest header of a file, bytes

// The types: the size in bytes, the typed array that holds values, and the method of a DataView that reads a value.
export const TYPES = {
  i1: [1, Int8Array, "getInt8"],
  u1: [1, Uint8Array, "getUint8"],
  i2: [2, Int16Array, "getInt16"],
  u2: [2, Uint16Array, "getUint16"],
  i4: [4, Int32Array, "getInt32"],
  u4: [4, Uint32Array, "getUint32"],
  i8: [8, Float64Array, "getBigInt64"],
  u8: [8, Float64Array, "getBigUint64"],
  f4: [4, Float32Array, "getFloat32"],
  f8: [8, Float64Array, "getFloat64"],
};

/** Return the size of a record, bytes. */
export function recordSize(fields) {
  return fields.reduce((size, { type, count }) => size + TYPES[type][0] * count, 0);
}

/** Read the first value of chosen fields {key: index} of binary records. The records begin at `start`. */
export function readBinary(bytes, start, points, fields, chosen, isLittle = true) {
  const stride = recordSize(fields), columns = {};
  for (const [key, index] of Object.entries(chosen)) {
    const offset = start + recordSize(fields.slice(0, index));
    columns[key] = readColumn(bytes, offset, stride, points, fields[index].type, isLittle);
  }
  return columns;
}

/** Read a column of values that are `stride` bytes apart. */
export function readColumn(bytes, offset, stride, points, type, isLittle = true) {
  const [, ArrayType, method] = TYPES[type];
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength), values = new ArrayType(points);
  for (let i = 0; i < points; i++) values[i] = Number(view[method](offset + i * stride, isLittle));
  return { values, isInteger: type[0] !== "f" };
}

/** Read chosen fields {key: index} of lines of text. The lines begin at `start`. */
export function readText(bytes, start, points, fields, chosen, name) {
  const lines = new TextDecoder("latin1").decode(bytes.subarray(start)).split("\n").filter((line) => line.trim());
  if (lines.length < points) {
    throw new InputError(`${name}: expected ${points} lines of points, found ${lines.length}; copy the file again`);
  }
  const entries = Object.entries(chosen);
  const places = entries.map(([, index]) => fields.slice(0, index).reduce((sum, { count }) => sum + count, 0));
  const table = entries.map(() => new Float64Array(points));
  for (let i = 0; i < points; i++) {
    const words = lines[i].trim().split(/\s+/);
    places.forEach((place, column) => (table[column][i] = numberOf(words[place])));
  }
  return Object.fromEntries(entries.map(([key, index], column) => [key, asType(table[column], fields[index].type)]));
}

/** Return a column of the type. A column with NaN or infinity stays float64, because integers cannot hold these. */
function asType(values, type) {
  if (!values.every(Number.isFinite)) return { values, isInteger: false };
  return { values: TYPES[type][1].from(values), isInteger: type[0] !== "f" };
}

function numberOf(word = "") {
  const value = Number(word);
  if (/^[-+.\de]+$/i.test(word) && !Number.isNaN(value)) return value;  // no hexadecimal number
  const special = /^([+-]?)(nan|inf|infinity)$/i.exec(word);
  if (!special) throw new Error(`could not convert '${word.slice(0, 20)}' to a number`);
  if (special[2].toLowerCase() === "nan") return NaN;
  return special[1] === "-" ? -Infinity : Infinity;
}

/** Reads the lines of a header. `end` names the line that ends the header. */
export class Header {
  constructor(bytes, name, kind, end) {
    Object.assign(this, { bytes, name, kind, end, position: 0 });
  }

  /** Return the words of the next line. */
  words() {
    const end = this.bytes.indexOf(10, this.position), next = end < 0 ? this.bytes.length : end + 1;
    if (this.position >= this.bytes.length || next > HEADER) {
      throw new InputError(
        `${this.name}: expected the header of ${this.kind}, found no ${this.end}; write the file again`,
      );
    }
    const line = new TextDecoder("latin1").decode(this.bytes.subarray(this.position, next)).trim();
    this.position = next;
    return line ? line.split(/\s+/) : [];
  }
}

/** Return a whole number from a word of a header. */
export function wholeOf(word = "nothing") {
  if (!/^[+-]?\d+$/.test(word)) throw new Error(`expected a whole number, found '${word.slice(0, 20)}'`);
  return Number(word);
}
