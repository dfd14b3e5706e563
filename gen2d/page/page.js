"use strict";
// The page of a dataset. Strings of the dataset enter the document as text only, never as HTML.
let data; // see page() in gen2d/page/page.py
const $ = (id) => document.getElementById(id);
const TRAIL = 14; // frames
const FLASH = 0.25; // s that a contact is shown
// What can be shown over the frames, and the field that it needs, if any.
const OVERLAYS = {
  Outlines: "", Velocities: "states/velocity", Contacts: "contacts/point", Trails: "", Boxes: "boxes/visible",
  Masks: "masks/instance", Numbers: "", Flow: "flow/forward", Depth: "surface/height", Normals: "surface/normal",
  Shadow: "surface/shadow",
};
const LAYERS = { Masks: "masks", Flow: "flow", Depth: "depth", Normals: "normals", Shadow: "shadow" }; // pictures
const KEYS = "1234567890-"; // of the overlays
const CURVES = ["#2a93a6", "#d1495b", "#edae49", "#8d6a9f", "#66a182", "#4a86b8", "#e07a5f"];
const state = { shown: [], step: 0, time: 0, playing: false, focus: 0, serial: 0, offset: 0 };
const shows = new Set();

function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

function drawing(name, attributes, text = "") {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = text;
  return made;
}

function complain(error) {
  $("problem").textContent = error.message || String(error);
  $("problem").hidden = false;
}

// ---- Videos

const bytes = (text) => Uint8Array.from(atob(text), (character) => character.charCodeAt(0));

async function inflated(text) {
  const stream = new Blob([bytes(text)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// The arrays [T, ...] of gen2d/page/arrays.py, as {shape, values}.
async function unpacked(packed) {
  const content = await inflated(packed.content);
  const arrays = {};
  let begin = 0;
  for (const { name, shape, low, step } of packed.columns) {
    const size = shape.reduce((product, length) => product * length, 1);
    const frames = shape[0];
    const width = frames ? size / frames : 0;
    const values = new Float64Array(size);
    for (let column = 0; column < width; column++) {
      let whole = 0;
      for (let t = 0; t < frames; t++) {
        const i = begin + column * frames + t;
        whole = (whole + content[i] + 256 * content[i + size]) & 65535;
        values[t * width + column] = low + step * whole;
      }
    }
    arrays[name] = { shape, values };
    begin += 2 * size;
  }
  return arrays;
}

async function opened(video) {
  const found = { ...video, count: Math.ceil(video.frames / video.stride) || 1 };
  found.arrays = await unpacked(video.arrays);
  for (const name of ["sprite", ...Object.values(LAYERS)]) {
    if (!video[name]) continue;
    const image = new Image();
    image.src = `data:image/webp;base64,${video[name].content}`;
    await image.decode();
    found[name] = { ...video[name], image };
  }
  return found;
}

const label = (video) => `${video.split} ${video.number}`;
const at = (array, t, k, part = 0, parts = 1) => array.values[(t * array.shape[1] + k) * parts + part];
