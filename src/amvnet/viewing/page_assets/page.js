// Put the parts of the page together: one look, one camera, one scan at a time. The page is drawn only after a change.
"use strict";

const look = new Look(), camera = new Camera();
const PLAY_INTERVAL = 800;  // the time between two scans during playback, milliseconds
const KEY_MOVE = 0.04;  // the movement of one key press, as a fraction of the window's height
const KEY_TURN = 0.023;  // the turn of one key press, as a fraction of the window's height; 4 degrees
let drawing, panel, tape, editor, scan = null, chosen = -1, playing = 0, remembering = 0;
let isStale = false, isDrawing = false;

/** Draw after the next frame, or after the picture on which the GPU works now. */
function redraw() {
  isStale = true;
  if (isDrawing) return;
  isDrawing = true;
  // The frame shows the picture before. The GPU finishes its work in order, so the next picture begins after the frame.
  requestAnimationFrame(() => setTimeout(nextPicture));
}

async function nextPicture() {
  isStale = false;
  if (scan) {
    begin();
    await drawing.finished();
    end();
  }
  isDrawing = false;
  if (isStale) redraw();
}

function begin() {
  camera.middle = panel.free();
  drawing.draw(scan, look, camera);
}

function end() {
  drawing.present();
  mark();
  tape.draw(scan, drawing.matrix);
}

/** Draw now, even if the page has to wait for the GPU. */
function draw() {
  begin();
  end();
}

/** Draw the ring around the point that was clicked. */
function mark() {
  const marker = byId("marker"), canvas = byId("canvas");
  marker.hidden = byId("point").hidden = chosen < 0;
  if (chosen < 0) return;
  const [u, v, , w] = projected(placeOf(scan, chosen), drawing.matrix);
  marker.hidden = w <= 0;
  marker.style.left = `${((u / w + 1) / 2) * canvas.clientWidth}px`;
  marker.style.top = `${((1 - v / w) / 2) * canvas.clientHeight}px`;
}

/** Change the look and show it. */
async function change(changes) {
  look.set(changes);
  await show();
  remember();
}

async function show() {
  const wanted = look.scan, found = await scanAt(wanted);
  if (look.scan !== wanted) return;  // another scan was chosen while this one was read
  if (found !== scan) {
    chosen = -1;
    tape.clear();
  }
  scan = found;
  if (look.labels === CORRECTED) editor.begin(scan);
  const drawn = panel.show(look, scan);
  editor.show(look, scan);
  byId("scan").value = wanted;
  byId("place").textContent = `${wanted + 1} of ${about.scans.length} · ${scan.name}`;
  byId("place").title = scan.name;
  redraw();
  // Programs that read the page, such as tests, find these values.
  Object.assign(document.documentElement.dataset, { drawn: JSON.stringify(drawn), scan: wanted, color: look.color });
}

/** Write the look into the page's address after a movement, not at every step of it. */
function remember() {
  clearTimeout(remembering);
  const place = [camera.azimuth, camera.elevation, camera.distance, ...camera.target];
  remembering = setTimeout(() => history.replaceState(null, "", look.hash(place)), 250);
}

/** Restore the look and the camera from the page's address. */
function recall() {
  const [azimuth, elevation, distance, ...target] = look.read(location.hash);
  const whole = target.length === 3 && [azimuth, elevation, distance, ...target].every(Number.isFinite);
  if (whole) camera.set({ azimuth, elevation, distance, target });
  else stand(FIRST);
  return show();
}

function moved() {
  redraw();
  remember();
}

/** Move the camera to a view, and farther away if the window is higher than wide. */
function stand(place) {
  camera.set({ ...place, distance: place.distance * Math.sqrt(Math.max(1, innerHeight / innerWidth)) });
  moved();
}

function step(by) {
  return change({ scan: (look.scan + by + about.scans.length) % about.scans.length });
}

function play() {
  document.body.classList.toggle("playing", !playing);
  clearInterval(playing);
  playing = playing ? 0 : setInterval(() => step(1), PLAY_INTERVAL);
}

function click(x, y, isDouble) {
  const { clientWidth: width, clientHeight: height } = byId("canvas");
  chosen = drawing.matrix ? pointAt(x, y, scan, look, drawing.matrix, width, height) : -1;
  if (chosen >= 0) describe(chosen, scan);
  mark();
  if (chosen >= 0 && tape.on) tape.add(chosen);
  if (chosen >= 0 && isDouble) camera.set({ ...camera, target: placeOf(scan, chosen) });
  moved();
}

/** Return the next element of a list; the first follows the last. */
function next(list, now) {
  return list[(list.indexOf(now) + 1) % list.length];
}

/** The keys of the page: [names, description, function]. A page with one scan has no keys that change the scan. */
const KEYS = [
  [["1", "2", "3", "4", "5"].slice(0, possible.labels.length), "first, second, ... labels",
    (key) => change({ labels: possible.labels[Number(key) - 1] })],
  [["C"], "next colouring", () => change({ color: next(possible.color, look.color) })],
  [["X"], "all, wrong or uncertain points", () => change({ only: next(possible.only, look.only) })],
  [["0"], "show all classes", () => change({ hidden: new Set() })],
  [["←", "→"], "previous, next scan", (key) => step(key === "→" ? 1 : -1)],
  [[" "], "play the scans", play],
  [["T"], "from above", () => stand(ABOVE)],
  [["F"], "close to the ground", () => stand(STREET)],
  [["R"], "first view", () => stand(FIRST)],
  [["W", "A", "S", "D"], "move", (key) => {
    camera.move({ A: KEY_MOVE, D: -KEY_MOVE }[key] ?? 0, { W: KEY_MOVE, S: -KEY_MOVE }[key] ?? 0);
    moved();
  }],
  [["Q", "E"], "turn", (key) => {
    camera.turn(key === "Q" ? KEY_TURN : -KEY_TURN, 0);
    moved();
  }],
  [["↑", "↓"], "zoom in, out", (key) => {
    camera.zoom(key === "↑" ? 0.9 : 1 / 0.9);
    moved();
  }],
  [["+", "-"], "larger, smaller points", (key) => change({
    size: Math.min(Math.max(look.size * (key === "+" ? 1.2 : 1 / 1.2), SIZES[0]), SIZES[1]),
  })],
  [["L"], "shading on, off", () => change({ shading: !look.shading })],
  [["G"], "rings every 10 m on, off", () => change({ rings: !look.rings })],
  [["M"], "measure between two points", () => tape.toggle()],
  [["B"], "a box around the point, no box", () => editor.toggleBox()],
  [["V"], "save a picture", savePicture],
  [["I"], "table of the labels' scores", () => about.table && byId("table").showModal()],
  [["P"], "fold or unfold the panel", () => panel.fold()],
  [["escape"], "deselect the point, clear the measurement", () => {
    tape.clear();
    click(-100, -100);
  }],
  [["?"], "this list", () => byId("keys").showModal()],
].filter(([names]) => names.length && (about.scans.length > 1 || !(names.includes("→") || names.includes(" "))));

/** Save what is drawn as a picture. The canvas must be read in the frame in which it was drawn. */
function savePicture() {
  if (!scan) return;
  draw();
  const canvas = byId("canvas"), picture = element("canvas", { width: canvas.width, height: canvas.height });
  const paper = picture.getContext("2d");
  paper.fillStyle = getComputedStyle(document.documentElement).getPropertyValue("--ground");
  paper.fillRect(0, 0, picture.width, picture.height);
  paper.drawImage(canvas, 0, 0);
  picture.toBlob((blob) => saveFile(blob, `${fileNameOf(scan)}.png`));
}

function start() {
  if (!("DecompressionStream" in window)) throw new Error("This page needs a browser of 2023 or later.");
  // A phone may take the GPU away from a page in the background.
  byId("canvas").addEventListener("webglcontextlost", (event) => event.preventDefault());
  byId("canvas").addEventListener("webglcontextrestored", () => location.reload());
  drawing = new Drawing(byId("canvas"));
  panel = new Panel(change);
  tape = new Tape(redraw);
  editor = new Editor(change, () => ({ look, scan, chosen }), (changed, plane) => drawing.refresh(changed, plane));
  new Pointers(byId("canvas"), camera, { camera: moved, click });
  listen(KEYS);
  byId("above").onclick = () => stand(ABOVE);
  byId("street").onclick = () => stand(STREET);
  byId("reset").onclick = () => stand(FIRST);
  byId("help").onclick = () => byId("keys").showModal();
  byId("measure").onclick = () => tape.toggle();
  byId("picture").onclick = savePicture;
  byId("show-table").onclick = () => byId("table").showModal();
  byId("play").onclick = play;
  byId("point").querySelector("button").onclick = () => click(-100, -100);
  byId("timeline").hidden = about.scans.length < 2;
  byId("scan").max = about.scans.length - 1;
  byId("scan").oninput = (event) => change({ scan: Number(event.target.value) });
  addEventListener("resize", redraw);
  new ResizeObserver(redraw).observe(byId("panel"));
  addEventListener("hashchange", () => recall().catch(fail));
  return recall();
}

function fail(error) {
  byId("problem").textContent = error.message;
  byId("problem").hidden = false;
}

(async () => start())().catch(fail);
