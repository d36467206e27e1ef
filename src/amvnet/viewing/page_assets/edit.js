// Draw only the points in a box, correct their labels, and save the labels as a label file.
"use strict";

const CORRECTED = "corrected";  // the plane that holds corrected labels
const BOX_HALF = 3;  // the distance from a clicked point to the sides of the box around it, metres
const AXES = ["x", "y", "z"];

/** Return a name for files about a scan: the scan's name without characters that a file name cannot have. */
function fileNameOf(scan) {
  return scan.name.split("/").at(-1).replace(/[^\w.-]/g, "_") || "scan";
}

function saveFile(blob, name) {
  const link = element("a", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

/**
 * Return the content of a label file, as bytes: the raw ids of a scan's labels. The ending decides the form: text, an
 * array of NumPy, bytes (nuScenes' .bin) or little-endian uint32.
 */
function labelFile(place, ids, raw) {
  const ending = place.split(".").at(-1), values = Array.from(ids, (id) => raw[id]);
  if (["txt", "csv"].includes(ending)) return new TextEncoder().encode(`${values.join("\n")}\n`);
  if (ending === "bin" && Math.max(...raw) < 256) return Uint8Array.from(values);
  const head = ending === "npy" ? arrayHeader(values.length) : "", bytes = new Uint8Array(head.length + 4 * values.length);
  for (let i = 0; i < head.length; i++) bytes[i] = head.charCodeAt(i);
  const view = new DataView(bytes.buffer, head.length);
  values.forEach((value, i) => view.setUint32(4 * i, value, true));
  return bytes;
}

/** Return the header of an .npy file with an array (count,) of little-endian uint32: 128 characters, each a byte. */
function arrayHeader(count) {
  const text = `{'descr': '<u4', 'fortran_order': False, 'shape': (${count},), }`;
  return `\x93NUMPY\x01\x00\x76\x00${text.padEnd(117)}\n`;
}

class Editor {
  /**
   * `change` is called with changes of the look. `now` returns {look, scan, chosen}. `refresh` is called with a scan
   * and the name of a plane that has new values.
   */
  constructor(change, now, refresh) {
    Object.assign(this, { change, now, refresh, before: [] });
    this.inputs = NO_BOX.map((bound, place) => element("input", {
      type: "number",
      ariaLabel: `${place < 3 ? "lowest" : "highest"} ${AXES[place % 3]}`,
      onchange: () => this.change({ box: this.read() }),
    }));
    byId("bounds").replaceChildren(...AXES.flatMap((name, axis) => [
      element("span", { text: name }), this.inputs[axis], element("span", { text: "to" }), this.inputs[axis + 3],
    ]));
    byId("class").replaceChildren(...about.classes.map((text, id) => element("option", { text, value: id })));
    byId("around").onclick = () => this.surround();
    byId("no-box").onclick = () => this.change({ box: NO_BOX });
    byId("apply").onclick = () => this.apply(Number(byId("class").value));
    byId("undo").onclick = () => this.undo();
    byId("save").onclick = () => this.save();
  }

  /** Return the box that the inputs describe; an empty input does not limit it. */
  read() {
    return boxOf(this.inputs.map(({ value }, place) => (value === "" ? NO_BOX[place] : Number(value))));
  }

  show(look, scan) {
    this.inputs.forEach((input, place) => {
      input.value = look.box[place] === NO_BOX[place] ? "" : Number(look.box[place].toFixed(2));
    });
    // A label file needs the ids that files have, and a label for every point of the scan.
    byId("edit").hidden = !about.sources.length || !about.raw || Boolean(scan.note);
    byId("box-title").textContent = byId("edit").hidden ? "Box" : "Box, correct labels";
    byId("undo").disabled = this.before.at(-1)?.scan !== scan;
    byId("save").disabled = !scan.planes[CORRECTED];
  }

  toggleBox() {
    if (this.now().look.box === NO_BOX) this.surround();
    else this.change({ box: NO_BOX });
  }

  /** Draw the box around the point that was clicked. */
  surround() {
    const { scan, chosen } = this.now();
    if (chosen < 0) {
      byId("edited").textContent = "Click a point first.";
      return;
    }
    byId("box").open = true;
    byId("edited").textContent = "";
    const place = placeOf(scan, chosen);
    const sides = [-BOX_HALF, BOX_HALF].flatMap((half) => place.map((value) => Number((value + half).toFixed(2))));
    this.change({ box: sides });
  }

  /** Copy a scan's labels to the plane of corrected labels. */
  begin(scan) {
    if (scan.planes[CORRECTED]) return;
    const from = predictions.filter((key) => scan.planes[key]).at(-1) ?? "truth";
    scan.planes[CORRECTED] = Uint8Array.from(scan.planes[from]);
    this.refresh(scan, CORRECTED);
  }

  /** Give a class to all points that are drawn. */
  apply(id) {
    const { look, scan } = this.now(), shown = shownBy(look, scan);
    const points = [...Array(scan.count).keys()].filter(shown);
    if (!predictions.includes(CORRECTED)) {
      about.sources.push({ key: CORRECTED, title: "Corrected" });
      possible.labels.push(CORRECTED);
    }
    if (!about.present.includes(id)) about.present = [...about.present, id].sort((a, b) => a - b);
    this.begin(scan);
    if (!predictions.includes(CORRECTED)) predictions.push(CORRECTED);
    const plane = scan.planes[CORRECTED];
    this.before.push({ scan, points, ids: points.map((i) => plane[i]) });
    for (const i of points) plane[i] = id;
    this.report(`${counted(points.length)} points are ${about.classes[id]} now.`, scan);
  }

  undo() {
    const { scan, points, ids } = this.before.pop();
    points.forEach((i, place) => { scan.planes[CORRECTED][i] = ids[place]; });
    this.report(`${counted(points.length)} points have their earlier label again.`, scan);
  }

  report(words, scan) {
    this.refresh(scan, CORRECTED);
    byId("edited").textContent = words;
    this.change({ labels: CORRECTED });
  }

  save() {
    const { scan } = this.now(), place = scan.corrected || `${fileNameOf(scan)}.label`;
    const name = place.replace(/^[./]+/, "").replace(/[^\w.-]+/g, "-");  // a download has no folders
    saveFile(new Blob([labelFile(place, scan.planes[CORRECTED], about.raw)]), name);
    byId("edited").textContent = `Saved as ${name}${name === place ? "" : `; its place is ${place}`}.`;
  }
}
