// Read and segment scans in a worker, so that the page stays responsive.
//
// The worker takes {id, file, folders, isPreview}: a scan file, and the folders of weights. The first weights are used
// that are made for the lasers of the scan; if none are, the first ones. It sends messages with the same id:
//
//   {kind: "began", work} and {kind: "step", title, seconds}  a step begins, and is done
//   {kind: "shown", folder, text, ...}  the scan for the viewer (`shownScan`), its weights, and what was assumed of it
//   {kind: "labelled", verdict, labels, places, total, classes, device, ...}  the same with labels
//   {kind: "failed", text}
//
// A newer request ends the work on an older one after its step.

import { InputError } from "./errors.js";
import { unpacked } from "./files.js";
import { segment } from "./method/amvnet.js";
import { Networks, readDescription } from "./method/networks.js";
import { verdictOf } from "./method/verdict.js";
import { readCloud } from "./reading/read.js";
import { normalise } from "./sensor/normalise.js";
import { shownScan } from "./shown.js";

const LARGEST_FILE = 200;  // the largest file that is read, megabytes
const MAX_THREADS = 8;
let runtime = null, networks = null;
let newestId = 0, lastWork = Promise.resolve();  // requests are worked on one after the other

addEventListener("message", ({ data }) => {
  newestId = data.id;
  lastWork = lastWork.then(() => label(data)).catch((error) => {
    if (!(error instanceof InputError)) console.warn(error);
    const text = error instanceof InputError ? error.message : `This is a fault of the page: ${error.message}`;
    postMessage({ id: data.id, kind: "failed", text });
  });
});

async function label({ id, file, folders, isPreview }) {
  const send = (kind, content) => postMessage({ id, kind, ...content });
  const step = async (title, work) => {
    await new Promise((resolve) => setTimeout(resolve));  // newer requests arrive now
    if (id !== newestId) throw new InputError("a newer request");  // the page ignores messages of this id now
    send("began", { work: title });
    const start = performance.now(), result = await work();
    send("step", { title, seconds: (performance.now() - start) / 1000 });
    return result;
  };

  const cloud = await step("read", async () => readCloud(await bytesOf(file), file.name));
  const { folder, description, scan } = await step("normalise", () => fitting(cloud, folders));
  send("shown", { folder, text: scan.text, ...shownScan(file.name, scan, null, description) });
  if (isPreview) return;

  runtime ??= await step("load ONNX Runtime", () => start(new URLSearchParams(location.search).get("device")));
  const run = async () => segment(await load(folder, description, step), scan, step);
  const segmentation = await run().catch(async (error) => {
    if (runtime.device === "wasm" || error instanceof InputError) throw error;
    runtime = await start("wasm");  // what the GPU could not do, the processor can
    networks = null;
    return run();
  });
  const shown = shownScan(file.name, scan, segmentation, description);
  const labels = segmentation.labels[description.method], { places, count: total } = scan;
  const verdict = verdictOf(segmentation, description, description.classes.length - 1);
  send("labelled", { ...shown, verdict, labels, places, total, classes: description.classes, device: runtime.text });
}

/**
 * Return {folder, description, scan} of the first weights that are made for the lasers of a cloud; if none are, of the
 * first ones. Weights that do not say for which lasers they are made are taken only if they are the first ones.
 */
async function fitting(cloud, folders) {
  let first = null;
  for (const folder of folders) {
    try {
      const description = await readDescription(folder);
      const scan = normalise(cloud, { view: description.range_view, ...description.expects });
      const isFirst = !first;
      first ??= { folder, description, scan };
      if (scan.isMadeFor ?? isFirst) return { folder, description, scan };
    } catch (error) {
      if (!first || !(error instanceof InputError)) throw error;  // else the first weights can label the scan
    }
  }
  return first;
}

/** Return the bytes of a file as Uint8Array; throw InputError if it is too large or cannot be read. */
async function bytesOf(file) {
  if (file.size > LARGEST_FILE * 1e6) {
    throw new InputError(
      `${file.name}: expected a file of at most ${LARGEST_FILE} MB, found ${(file.size / 1e6).toFixed(0)} MB; ` +
      "split it into scans, or label it with amvnet predict",
    );
  }
  try {
    return new Uint8Array(await file.arrayBuffer());
  } catch {
    throw new InputError(`${file.name}: expected a file that can be read, found a folder or a changed file; drop a scan again`);
  }
}

/** Load ONNX Runtime, for the GPU if `wanted` is "webgpu" and the browser offers one. Return {ort, device, text}. */
async function start(wanted) {
  const isPossible = wanted === "webgpu" && "Suspending" in WebAssembly;
  const adapter = isPossible ? await navigator.gpu?.requestAdapter() : null, device = adapter ? "webgpu" : "wasm";
  const [api, core] = adapter ? ["ort.jspi.min", "ort-wasm-simd-threaded.jspi"] : ["ort.wasm.min", "ort-wasm-simd-threaded"];
  const ort = await import(`./ort/${api}.js`);
  const threads = crossOriginIsolated ? Math.min(navigator.hardwareConcurrency, MAX_THREADS) : 1;
  const wasmPaths = { mjs: new URL(`./ort/${core}.js`, import.meta.url).href };
  Object.assign(ort.env.wasm, { wasmPaths, wasmBinary: await unpacked(`ort/${core}.wasm.gz`), numThreads: threads });
  const many = threads > 1 ? `${threads} threads` : "one thread";
  return { ort, device, text: adapter ? "on the GPU" : `with ${many}` };
}

/** Return the networks of a folder; drop the networks of any other folder. */
async function load(folder, description, step) {
  if (networks?.folder === folder) return networks;
  for (const session of Object.values(networks?.sessions ?? {})) await session.release();
  networks = null;
  return (networks = await step("load the networks", () => Networks.load(runtime, folder, description)));
}
