// The page around the viewer takes scans, shows what the worker does with them, and offers the labels.

import { counted } from "./errors.js";
import { partsOf, rawIds, save } from "./download.js";
import { fetched, fetchedJson } from "./files.js";

const byId = (id) => document.getElementById(id);
const worker = new Worker(`worker.js${location.search}`, { type: "module" });
let models = [], file = null, asked = 0, started = 0, result = null;

/**
 * Ask the worker to label the file, or only to show it. Answers to earlier requests are then ignored.
 *
 * If `isNew`, the worker takes other weights than the chosen ones if only these know the lasers of the scan.
 */
function ask({ isPreview = false, isNew = false } = {}) {
  if (!file || !models.length || document.documentElement.dataset.state === "unusable") return;
  result = null;
  asked++;
  started = performance.now();
  byId("steps").replaceChildren();
  byId("assumed").textContent = "";
  for (const id of ["problem", "options", "downloads"]) byId(id).hidden = true;
  setState(isPreview ? "reading" : "labelling", `${file.name} …`);
  const chosen = models[byId("weights").selectedIndex].folder, others = isNew ? models.map(({ folder }) => folder) : [];
  worker.postMessage({ id: asked, file, folders: [...new Set([chosen, ...others])], isPreview });
}

/** Show the state of the work. Programs that read the page, such as tests, find it in `data-state`. */
function setState(state, text) {
  document.documentElement.dataset.state = state;
  byId("state").textContent = text;
  byId("label").disabled = !file || state === "labelling";
}

const ON_MESSAGE = {
  began: ({ work }) => (byId("state").textContent = `${work} …`),
  step: ({ title, seconds }) => {
    const row = byId("steps").insertRow();
    for (const text of [title, `${seconds.toFixed(2)} s`]) row.insertCell().textContent = text;
  },
  shown: (shown) => {
    byId("assumed").textContent = `${shown.scan.name}: ${shown.text}`;
    byId("weights").selectedIndex = models.findIndex(({ folder }) => folder === shown.folder);
    byId("options").hidden = !shown.text.includes("--");
    show(shown);
    if (document.documentElement.dataset.state === "reading") setState("shown", "");
  },
  labelled: (labelled) => {
    result = labelled;
    const seconds = (performance.now() - started) / 1000;
    show(labelled);
    byId("downloads").hidden = false;
    const { isDoubtful, text } = result.verdict ?? {};
    byId("problem").textContent = isDoubtful ? text : "";
    byId("problem").hidden = !isDoubtful;
    const sure = text && !isDoubtful ? `; ${text}` : "";
    setState("labelled", `${counted(result.total)} points labelled in ${seconds.toFixed(1)} s, ${result.device}${sure}`);
  },
  failed: ({ text }) => fail(text),
};

function fail(text, state = "failed") {
  byId("problem").textContent = text;
  byId("problem").hidden = false;
  setState(state, "");
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
    open(event.dataTransfer.files);
  });
}

function open(files) {
  if (files.length > 1) return fail(`expected one scan, found ${files.length} files; drop one of them`);
  if (!files.length) return;  // a text was dropped, or no file was chosen
  [file] = files;
  ask({ isNew: true });
}

async function start() {
  worker.onmessage = ({ data }) => data.id === asked && ON_MESSAGE[data.kind](data);
  worker.onerror = () => fail("expected a browser of 2023 or later, found one that cannot run this page; use another", "unusable");
  takeDrops(window);
  byId("file").onchange = ({ target }) => {
    open(target.files);
    target.value = "";  // so that the same file can be chosen again
  };
  byId("label").onclick = () => ask();
  byId("weights").onchange = () => ask();
  for (const kind of ["label", "npy"]) {
    byId(`save-${kind}`).onclick = () => {
      const ids = rawIds(result.labels, result.places, result.total, result.classes);
      save(`${file.name.replace(/\.[^.]*$/, "")}.${kind}`, partsOf(kind, ids));
    };
  }

  setState("reading", "loading a sample scan …");
  models = await fetchedJson("models.json", "mend it, or build the page again");
  byId("weights").replaceChildren(...models.map(({ title }) => new Option(title)));
  const { sample } = models[0];
  if (file) return ask({ isNew: true });  // a scan was dropped in the meantime
  if (!sample) return setState("empty", "");
  const contents = await (await fetched(sample)).blob();
  if (file) return;
  file = new File([contents], sample.split("/").at(-1));
  ask({ isPreview: true });
}

start().catch((error) => fail(error.message));
