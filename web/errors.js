/** Input that cannot be used. One line says what was expected, what was found and what to do, as `amvnet predict` does. */
export class InputError extends Error {}

/** Return text from a file for an error message: in quotes, in one line, and short. */
export function quoted(text, longest = 100) {
  return `'${[...text].slice(0, longest).map((letter) => (/[ -~]/.test(letter) ? letter : "?")).join("")}'`;
}

/** Return a number with commas between thousands. */
export function counted(count) {
  return count.toLocaleString("en");
}
