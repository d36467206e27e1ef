// Read point clouds from PLY files: the element `vertex`, ascii or binary in either byte order.

import { InputError, quoted } from "../errors.js";
import { checkPointCount, makeCloud, requireColumns } from "./cloud.js";
import { Header, readBinary, readText, recordSize, wholeOf } from "./fields.js";

// The types by PLY's names; most types have two names.
const TYPES = {
  char: "i1", int8: "i1", uchar: "u1", uint8: "u1", bool: "u1", short: "i2", int16: "i2", ushort: "u2", uint16: "u2",
  int: "i4", int32: "i4", uint: "u4", uint32: "u4", float: "f4", float32: "f4", double: "f8", float64: "f8",
};
const FORMATS = ["ascii", "binary_little_endian", "binary_big_endian"];

/** Return the cloud of the vertices in a file, given its bytes. */
export function readPly(bytes, name) {
  const header = new Header(bytes, name, "a PLY file", "end_header"), { format, elements } = readElements(header, name);
  const place = elements.findIndex((element) => element.name === "vertex");
  if (place < 0) throw new Error("no element vertex");

  const before = elements.slice(0, place), { count, fields } = elements[place];
  for (const { type, name: property } of elements.slice(0, place + 1).flatMap((element) => element.fields)) {
    if (type === "list") throw new InputError(`${name}: expected vertices without lists, found a list; write the points alone`);
    if (!type) throw new Error(`the type of ${property}`);
  }

  const chosen = requireColumns(fields.map((field) => field.name), name);
  if (format === "ascii") {
    // Each value, and each line before the vertices, takes at least one character. Another character separates two.
    const lines = before.reduce((sum, element) => sum + element.count, 0);
    checkPointCount(lines + count, name, bytes.length, 2 * (lines + count * fields.length) - 1);
    for (let line = 0; line < lines; line++) header.words();
    return makeCloud(readText(bytes, header.position, count, fields, chosen, name), name);
  }

  const start = before.reduce((sum, element) => sum + element.count * recordSize(element.fields), header.position);
  checkPointCount(count, name, bytes.length, start + count * recordSize(fields));
  return makeCloud(readBinary(bytes, start, count, fields, chosen, format !== "binary_big_endian"), name);
}

/** Return the format and the elements [{name, count, fields}] that a header describes. */
function readElements(header, name) {
  const elements = [];
  let format = "", words = [];
  while (!(words.length === 1 && words[0] === "end_header")) {
    words = header.words();
    if (words[0] === "format") format = words[1] ?? "";
    if (words[0] === "element") elements.push({ name: words[1], count: wholeOf(words[2]), fields: [] });
    if (words[0] === "property") {
      if (!elements.length) throw new Error("a property before the first element");
      const type = words[1] === "list" ? "list" : TYPES[words[1]];
      elements.at(-1).fields.push({ name: words.at(-1), type, count: 1 });
    }
  }
  if (elements.some(({ count }) => count < 0)) throw new Error("an element with a negative number of rows");
  if (FORMATS.includes(format)) return { format, elements };
  throw new InputError(
    `${name}: expected the format ${FORMATS.join(", ")}, found ${quoted(format, 30)}; write the file again`,
  );
}
