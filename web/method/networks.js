// Run the networks, which are graphs of `amvnet export`, in ONNX Runtime Web.

import { InputError } from "../errors.js";
import { fetchedJson, unpacked } from "../files.js";
import { scoreHidden } from "./range_view.js";
import { addToMaxima, atCells, FEATURES, toMap } from "./polar_view.js";

const FORMAT = 3, DESCRIPTION = "amvnet.json", ADVICE = "export the weights again with amvnet export";
const POLAR = ["polar_points", "polar_pillars", "polar_map", "polar_scores"];
// The graphs that each method needs.
const GRAPHS = {
  rv: ["range_net"],
  bev: POLAR,
  ensemble: ["range_net", ...POLAR],
  amvnet: ["range_net", ...POLAR, "point_head"],
};
// In its own layout, NHWC, ONNX Runtime's WebGPU miscomputes convolutions of images with six channels (its issue 29651).
const PROVIDERS = { webgpu: [{ name: "webgpu", preferredLayout: "NCHW" }, "wasm"], wasm: ["wasm"] };
const PART = 16_384;  // the number of points or pillars that a graph takes at a time, which limits the memory

/** Read the description in a folder of `amvnet export`. */
export async function readDescription(folder) {
  const description = await fetchedJson(`${folder}/${DESCRIPTION}`, ADVICE);
  if (description.format !== FORMAT || !(description.method in GRAPHS)) {
    throw new InputError(
      `${folder}/${DESCRIPTION}: expected format ${FORMAT} and a known method, found another file; ${ADVICE}`,
    );
  }
  return description;
}

export class Networks {
  /** Load the graphs of a folder into a runtime {ort, device}. */
  static async load({ ort, device }, folder, description) {
    const networks = new Networks();
    Object.assign(networks, { ort, folder, description, sessions: {}, k: description.classes.length - 1 });
    for (const name of GRAPHS[description.method]) {
      const graph = await unpacked(`${folder}/${description.graphs[name]?.file}`, ADVICE);
      networks.sessions[name] = await ort.InferenceSession.create(new Uint8Array(graph), { executionProviders: PROVIDERS[device] });
    }
    return networks;
  }

  /** Return the probabilities (n K) of points by the range view. */
  async scoreRangeView(projection, points) {
    const { range_view: view } = this.description, size = view.height * view.width, { image, pixel } = projection;
    const logits = await this.run("range_net", [[image, [1, image.length / size, view.height, view.width]]]);
    const scoresAt = (pixels) => softmax(atCells(logits, pixels, size), this.k);
    return scoreHidden(view, projection, points, scoresAt(pixel), scoresAt);
  }

  /** Return the probabilities (n K) of points by the bird's-eye view. */
  async scorePolarView({ features, pillar, voxel, isSeen }) {
    const { radial, angular, vertical, nearest } = this.description.polar_view, size = radial * angular;
    const maxima = new Map();
    for (const part of partsOf(Uint32Array.from(pillar.keys()).filter((i) => isSeen[i]))) {
      const rows = new Float32Array(FEATURES * part.length);
      part.forEach((i, row) => rows.set(features.subarray(FEATURES * i, FEATURES * (i + 1)), FEATURES * row));
      const pointFeatures = await this.run("polar_points", [[rows, [part.length, FEATURES]]]);
      addToMaxima(maxima, Int32Array.from(part, (i) => pillar[i]), pointFeatures);
    }

    if (!maxima.size) throw new InputError(`expected points beyond ${nearest} m of the sensor, found none; leave the file out`);
    const seen = [...maxima.keys()], channels = maxima.get(seen[0]).length, pooled = new Float32Array(seen.length * channels);
    seen.forEach((place, row) => pooled.set(maxima.get(place), row * channels));
    const pillars = toMap(await this.run("polar_pillars", [[pooled, [seen.length, channels]]]), seen, size);
    const decoded = await this.run("polar_map", [[pillars, [1, pillars.length / size, radial, angular]]]);

    // Pillars whose points are all too near to be seen also have scores.
    const occupied = Int32Array.from(new Set(pillar)), slots = new Int32Array(size);
    occupied.forEach((place, slot) => (slots[place] = slot));
    const logits = new Float32Array(pillar.length * this.k), scores = [];
    for (const part of partsOf(occupied)) {
      const values = atCells(decoded, part, size);
      scores.push(await this.run("polar_scores", [[values, [part.length, values.length / part.length]]]));
    }
    for (let i = 0; i < pillar.length; i++) {
      const slot = slots[pillar[i]], start = ((slot % PART) * vertical + voxel[i]) * this.k;
      logits.set(scores[Math.floor(slot / PART)].subarray(start, start + this.k), i * this.k);
    }
    return softmax(logits, this.k);
  }

  /** Return the head's probabilities (u K) of uncertain points, given the features of points and their neighbours. */
  async scorePoints(point, rows, count) {
    const width = point.length / count, n = rows.length / point.length;
    return softmax(await this.run("point_head", [[point, [count, width]], [rows, [count, n, width]]]), this.k);
  }

  /** Run a graph on inputs [[values, shape], ...]; return the values of its output. */
  async run(name, inputs) {
    const names = this.description.graphs[name].inputs.map((input) => input.name);
    const feeds = inputs.map(([values, shape], place) => [names[place], new this.ort.Tensor("float32", values, shape)]);
    const output = Object.values(await this.sessions[name].run(Object.fromEntries(feeds)))[0], values = output.data.slice();
    output.dispose();
    return values;
  }
}

/** Return consecutive parts of a typed array. */
function partsOf(values) {
  return Array.from({ length: Math.ceil(values.length / PART) }, (_, part) => values.subarray(part * PART, (part + 1) * PART));
}

/** Turn logits (n K) into probabilities, in place. */
function softmax(scores, k) {
  for (let start = 0; start < scores.length; start += k) {
    const row = scores.subarray(start, start + k), largest = row.reduce((a, b) => Math.max(a, b));
    let sum = 0;
    for (let c = 0; c < k; c++) sum += row[c] = Math.exp(row[c] - largest);
    for (let c = 0; c < k; c++) row[c] /= sum;
  }
  return scores;
}
