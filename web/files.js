// The files of this page, in its folder.

import { InputError } from "./errors.js";

const GZIP = 0x1f;  // the first byte of a compressed file

/** Return the response with a file; `advice` says what to do if there is none. */
export async function fetched(path, advice = "build the page again") {
  const response = await fetch(path);
  if (!response.ok) throw new InputError(`${path}: expected a file beside this page, found none; ${advice}`);
  return response;
}

/** Return the contents of a JSON file. */
export async function fetchedJson(path, advice) {
  const text = await (await fetched(path, advice)).text();
  try {
    return JSON.parse(text);
  } catch (error) {
    throw new InputError(`${path}: expected JSON, found another text (${error.message}); ${advice}`);
  }
}

/** Return the contents of a file that the build may have compressed. Some hosts let the browser unpack such files already. */
export async function unpacked(path, advice) {
  const file = await (await fetched(path, advice)).blob(), [first] = new Uint8Array(await file.slice(0, 1).arrayBuffer());
  const contents = first === GZIP ? file.stream().pipeThrough(new DecompressionStream("gzip")) : file.stream();
  return new Response(contents).arrayBuffer();
}
