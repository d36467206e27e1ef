// Read and segment scans in a worker, so that the page stays responsive.
//
// The worker takes {id, file, folder, isPreview}: a scan file, and the folder of the weights. It sends messages with
// the same id: {kind: "loading", share}, {kind: "step", title, seconds}, {kind: "shown", ...},
// {kind: "labelled", ...} and {kind: "failed", text}.

import { InputError } from "./errors.js";
import { segment } from "./method/amvnet.js";
import { Networks, readDescription } from "./method/networks.js";
import { readCloud } from "./reading/read.js";
import { normalise } from "./sensor/normalise.js";
import { shownScan } from "./shown.js";

const LARGEST_FILE = 200;  // the largest file that is read, megabytes
const MAX_THREADS = 8;
let runtime = null, loaded = { folder: null, networks: null }, last = Promise.resolve();

addEventListener("message", ({ data }) => {
  last = last.then(() => label(data)).catch((error) => {
    if (!(error instanceof InputError)) console.warn(error);
    const text = error instanceof InputError ? error.message : `This is a fault of the page: ${error.message}`;
    postMessage({ id: data.id, kind: "failed", text });
  });
});

async function label({ id, file, folder, isPreview }) {
  const send = (kind, content) => postMessage({ id, kind, ...content });
  const step = async (title, work) => {
    const start = performance.now(), result = await work();
    send("step", { title, seconds: (performance.now() - start) / 1000 });
    return result;
  };

  const description = await readDescription(folder);
  const cloud = await step("read", async () => readCloud(await bytesOf(file), file.name));
  const scan = await step("normalise", () => normalise(cloud, expectationOf(description)));
  send("shown", { text: scan.text, ...shownScan(file.name, scan, null, description) });
  if (isPreview) return;

  runtime ??= await start(new URLSearchParams(location.search).get("device"));
  const run = async () => segment(await load(folder, description, (share) => send("loading", { share })), scan, step);
  const segmentation = await run().catch(async (error) => {
    if (runtime.device === "wasm" || error instanceof InputError) throw error;
    runtime = await start("wasm");  // the GPU has failed
    loaded = { folder: null, networks: null };
    return run();
  });
  const shown = shownScan(file.name, scan, segmentation, description);
  const labels = segmentation.labels[description.method], { places, count: total } = scan;
  send("labelled", { ...shown, labels, places, total, classes: description.classes, device: runtime.text });
}

async function bytesOf(file) {
  if (file.size > LARGEST_FILE * 1e6) {
    const size = (file.size / 1e6).toFixed(0);
    throw new InputError(
      `${file.name}: expected a file of at most ${LARGEST_FILE} MB, found ${size} MB; split it into scans, ` +
      "or label it with amvnet predict",
    );
  }
  return new Uint8Array(await file.arrayBuffer());
}

/** Return a description of the scans that the weights know, for `normalise`. */
function expectationOf({ range_view: view, normalise: { sensor, intensity, as_is: isAsIs } }) {
  return { view, sensor, intensity, isAsIs };
}

/** Load ONNX Runtime, for the GPU if `wanted` is "webgpu" and the browser offers one. Return {ort, device, text}. */
async function start(wanted) {
  const isPossible = wanted === "webgpu" && "Suspending" in WebAssembly;
  const adapter = isPossible ? await navigator.gpu?.requestAdapter() : null, device = adapter ? "webgpu" : "wasm";
  const ort = await import(`./ort/ort.${adapter ? "jspi" : "wasm"}.min.mjs`);
  const threads = crossOriginIsolated ? Math.min(navigator.hardwareConcurrency, MAX_THREADS) : 1;
  ort.env.wasm.wasmPaths = new URL("./ort/", import.meta.url).href;
  ort.env.wasm.numThreads = threads;
  const many = threads > 1 ? `${threads} threads` : "one thread";
  return { ort, device, text: adapter ? "on the GPU" : `with ${many}` };
}

/** Return the networks of a folder; drop the networks of any other folder. */
async function load(folder, description, progress) {
  if (loaded.folder === folder) return loaded.networks;
  await loaded.networks?.release();
  loaded = { folder: null, networks: null };
  const networks = await Networks.load(runtime.ort, folder, description, runtime.device, progress);
  loaded = { folder, networks };
  return networks;
}
