// Read the scans that the page carries: planes of bytes, deflated and in base64.
"use strict";

const about = JSON.parse(document.getElementById("about").textContent);
const loaded = new Map();  // the promise of each scan, by its index

function bytesOf(text) {
  const characters = atob(text), bytes = new Uint8Array(characters.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = characters.charCodeAt(i);
  return bytes;
}

async function inflated(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Return (3 n) int16 x, y, z, x, ..., given the low bytes and then the high bytes of the differences on each axis. */
function positionsOf(bytes, count) {
  const positions = new Int16Array(3 * count);
  for (let axis = 0; axis < 3; axis++) {
    const low = 2 * axis * count, high = low + count;
    for (let i = 0, value = 0; i < count; i++) {
      value = (value + bytes[low + i] + (bytes[high + i] << 8)) & 0xffff;
      positions[3 * i + axis] = value;  // wraps to -32768..32767
    }
  }
  return positions;
}

async function read(index) {
  const header = about.scans[index];
  const bytes = await inflated(bytesOf(document.getElementById(`scan-${index}`).textContent));
  const planes = {};
  header.planes.forEach((name, place) => {
    planes[name] = bytes.subarray((6 + place) * header.count, (7 + place) * header.count);
  });
  return { ...header, index, planes, positions: positionsOf(bytes, header.count) };
}

/** Return a promise of a scan: {name, count, center, step, positions, planes: {intensity, truth, ...}}. */
function scanAt(index) {
  if (!loaded.has(index)) loaded.set(index, read(index));
  return loaded.get(index);
}

/** Return [x, y, z] of a point in the sensor's frame, metres. */
function placeOf(scan, i) {
  return [0, 1, 2].map((axis) => scan.center[axis] + scan.step[axis] * scan.positions[3 * i + axis]);
}
