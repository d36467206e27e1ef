// Read a scan file; its first bytes or, failing that, its name tell the format.

import { InputError } from "../errors.js";
import { readNpy } from "./npy.js";
import { readPcd } from "./pcd.js";
import { readPly } from "./ply.js";
import { readRaw } from "./raw.js";

const KINDS = {
  ".bin": { read: readRaw, expected: "rows of float32" },
  ".pcd": { read: readPcd, expected: "a PCD file" },
  ".ply": { read: readPly, expected: "a PLY file" },
  ".npy": { read: readNpy, expected: "an array of NumPy" },
};
// The format of a file by its first bytes: the formats that are read, and others.
const BEGINNINGS = { "VERSION": ".pcd", "FIELDS": ".pcd", "ply\n": ".ply", "ply\r": ".ply", "\x93NUMPY": ".npy" };
const OTHERS = { "PK\x03\x04": ".npz", "LASF": ".las", "#ROSBAG": ".bag", "\x89MCAP0": ".mcap" };
const COMMENTS = /^(?:#[^\n]*\n|\s*\n)+/;  // the lines that may precede the header of a PCD file

/** Return the cloud of a scan file, given its bytes and its name. */
export function readCloud(bytes, name) {
  const kind = KINDS[endingOf(bytes, name)];
  try {
    return kind.read(bytes, name);
  } catch (error) {
    if (error instanceof InputError) throw error;
    const reason = error.message.replace(/\s+/g, " ").slice(0, 160);
    throw new InputError(`${name}: expected ${kind.expected}, found a broken file (${reason}); write the file again`);
  }
}

function endingOf(bytes, name) {
  const head = String.fromCharCode(...bytes.subarray(0, 4096)), heads = [head, head.replace(COMMENTS, "")];
  const begins = (beginnings) => {
    const found = Object.keys(beginnings).find((text) => heads.some((each) => each.startsWith(text)));
    return beginnings[found];
  };
  const named = Object.keys(KINDS).find((ending) => name.toLowerCase().endsWith(ending));
  const ending = begins(BEGINNINGS) ?? (begins(OTHERS) ? undefined : named);
  if (ending) return ending;
  throw new InputError(
    `${name}: expected a scan file (.pcd.bin, ${Object.keys(KINDS).join(", ")}), found another format; ` +
    "convert it to one of these, or label it with amvnet predict",
  );
}
