// The page around the viewer takes scans, shows what the worker does with them, and offers the labels.

import { counted } from "./errors.js";
import { partsOf, rawIds, save } from "./download.js";

const byId = (id) => document.getElementById(id);
const worker = new Worker(`worker.js${location.search}`, { type: "module" });
let models = [], file = null, asked = 0, started = 0, result = null;

async function fetched(path) {
  const response = await fetch(path);
  if (!response.ok) throw new Error(`${path}: expected a file of this page, found none; build the page again`);
  return response;
}

/** Ask the worker to label the file, or only to show it. Answers to earlier requests are then ignored. */
function ask(isPreview = false) {
  if (!file) return;
  result = null;
  asked++;
  started = performance.now();
  byId("steps").replaceChildren();
  byId("assumed").textContent = "";
  byId("problem").hidden = byId("downloads").hidden = true;
  setState(isPreview ? "reading" : "labelling", isPreview ? "" : `${file.name} …`);
  worker.postMessage({ id: asked, file, folder: chosen().folder, isPreview });
}

function chosen() {
  return models[byId("weights").selectedIndex];
}

/** Show the state of the work. Programs that read the page, such as tests, find it in `data-state`. */
function setState(state, text) {
  document.documentElement.dataset.state = state;
  byId("state").textContent = text;
  byId("label").disabled = state === "labelling";
}

const ON_MESSAGE = {
  loading: ({ share }) => setState("labelling", `loading the networks, ${Math.round(100 * share)} %`),
  step: ({ title, seconds }) => addStep(title, seconds),
  shown: (shown) => {
    byId("assumed").textContent = `${shown.scan.name}: ${shown.text}`;
    show(shown);
    if (document.documentElement.dataset.state === "reading") setState("shown", "");
  },
  labelled: (labelled) => {
    result = labelled;
    const seconds = (performance.now() - started) / 1000;
    show(labelled);
    byId("downloads").hidden = false;
    setState("labelled", `${counted(result.total)} points labelled in ${seconds.toFixed(1)} s, ${result.device}`);
  },
  failed: ({ text }) => fail(text),
};

function addStep(title, seconds) {
  const row = byId("steps").insertRow();
  row.insertCell().textContent = title;
  row.insertCell().textContent = `${seconds.toFixed(2)} s`;
}

function fail(text) {
  byId("problem").textContent = text;
  byId("problem").hidden = false;
  setState("failed", "");
}

/** Show a scan in a new frame, from the same point of view as the scan before. */
function show(shown) {
  const before = byId("viewer"), frame = before.cloneNode();
  const camera = before.src ? /camera=[^&]*/.exec(before.contentWindow.location.hash) : null;
  window.shown = shown;  // viewer_data.js reads it
  frame.src = `viewer.html${camera ? `#${camera[0]}` : ""}`;
  frame.onload = () => takeDrops(frame.contentWindow);
  before.replaceWith(frame);
}

/** Let files be dropped on a window, which is the page's or the frame's. */
function takeDrops(target) {
  target.addEventListener("dragover", (event) => {
    event.preventDefault();
    document.body.classList.add("dropping");
  });
  target.addEventListener("dragleave", () => document.body.classList.remove("dropping"));
  target.addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("dropping");
    open(event.dataTransfer.files[0]);
  });
}

function open(dropped) {
  if (!dropped) return;
  file = dropped;
  ask();
}

async function start() {
  worker.onmessage = ({ data }) => data.id === asked && ON_MESSAGE[data.kind](data);
  worker.onerror = () => fail("expected a browser of 2023 or later, found one that cannot run this page; use another");
  takeDrops(window);
  byId("file").onchange = (event) => open(event.target.files[0]);
  byId("label").onclick = () => ask();
  byId("weights").onchange = () => ask();
  for (const kind of ["label", "npy"]) {
    byId(`save-${kind}`).onclick = () => {
      const ids = rawIds(result.labels, result.places, result.total, result.classes);
      save(`${file.name.replace(/\.[^.]*$/, "")}.${kind}`, partsOf(kind, ids));
    };
  }

  models = await (await fetched("models.json")).json();
  byId("weights").replaceChildren(...models.map(({ title }) => new Option(title)));
  const { sample } = models[0];
  if (!sample) return setState("empty", "");
  file = new File([await (await fetched(sample)).blob()], sample.split("/").at(-1));
  ask(true);
}

start().catch((error) => fail(error.message));
