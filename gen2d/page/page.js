"use strict";
// The page of a dataset. Strings of the dataset enter the document as text only, never as HTML.
let data; // see page() in gen2d/page/page.py
const $ = (id) => document.getElementById(id);
const TRAIL = 14; // frames
const FLASH = 0.25; // s that a contact is shown
const OVERLAYS = ["Outlines", "Velocities", "Contacts", "Trails", "Boxes", "Masks", "Numbers"];
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
  for (const name of ["sprite", "masks"]) {
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

// ---- Drawing

// From metres to pixels of the dataset's frames.
function camera(video, t) {
  const { "camera/center": center, "camera/scale": scale, "camera/angle": turn } = video.arrays;
  if (!center || !scale) return null;
  const angle = turn ? turn.values[t] : 0;
  const [cos, sin, s] = [Math.cos(angle), Math.sin(angle), scale.values[t]];
  const [cx, cy] = [center.values[2 * t], center.values[2 * t + 1]];
  return {
    scale: s,
    angle,
    point: (x, y) => [
      video.width / 2 + s * ((x - cx) * cos + (y - cy) * sin),
      video.height / 2 - s * ((y - cy) * cos - (x - cx) * sin),
    ],
  };
}

function outline(context, objects, k, x, y, angle, scale) {
  const shape = objects.shape?.[k];
  const radius = (objects["objects/radius"]?.[k] || 0) * scale;
  context.save();
  context.translate(x, y);
  context.rotate(-angle);
  context.beginPath();
  if (shape === "circle") {
    context.arc(0, 0, radius, 0, 2 * Math.PI);
  } else if (shape === "polygon" && objects.vertices) {
    objects.vertices[k].forEach(([vx, vy]) => context.lineTo(vx * scale, -vy * scale));
    context.closePath();
  } else if (shape === "capsule" || shape === "segment") {
    const half = (objects["objects/half_length"]?.[k] || 0) * scale;
    context.arc(half, 0, radius, -Math.PI / 2, Math.PI / 2);
    context.arc(-half, 0, radius, Math.PI / 2, (3 * Math.PI) / 2);
    context.closePath();
  }
  context.restore();
}

const color = (objects, k) => (objects.color ? `rgb(${objects.color[k].join(" ")})` : CURVES[k % CURVES.length]);

function drawScene(context, video, t, view, unit) {
  const position = video.arrays["states/position"];
  if (!position || !view) return;
  const order = video.objects.slot.map((_, k) => k);
  const depth = video.objects["objects/depth"];
  if (depth) order.sort((a, b) => depth[a] - depth[b]);
  for (const k of order) {
    const [x, y] = view.point(at(position, t, k, 0, 2), at(position, t, k, 1, 2));
    outline(context, video.objects, k, x, y, angleOf(video, t, k) - view.angle, view.scale);
    context.fillStyle = context.strokeStyle = color(video.objects, k);
    context.lineWidth = 2 * unit;
    context.fill();
    context.stroke();
  }
}

function angleOf(video, t, k) {
  const angles = video.arrays["states/angle"];
  return angles ? at(angles, t, k) : 0;
}

// Frame t of a sprite sheet, over the whole canvas.
function drawSprite(context, video, { image, width, height, rows }, t) {
  const [x, y] = [Math.floor(t / rows) * width, (t % rows) * height];
  context.drawImage(image, x, y, width, height, 0, 0, video.width, video.height);
}

function halo(context, unit, paint, width) {
  for (const [stroke, extra] of [["rgb(0 0 0 / 60%)", 2.2], [paint, 0]]) {
    context.strokeStyle = stroke;
    context.lineWidth = (width + extra) * unit;
    context.stroke();
  }
}

function drawTrails(context, video, t, view, unit) {
  const position = video.arrays["states/position"];
  for (let k = 0; k < video.objects.slot.length; k++) {
    if (fixed(video.objects, k)) continue;
    context.beginPath();
    for (let s = Math.max(0, t - TRAIL); s <= t; s++) {
      context.lineTo(...view.point(at(position, s, k, 0, 2), at(position, s, k, 1, 2)));
    }
    halo(context, unit, color(video.objects, k), 2);
  }
}

const fixed = (objects, k) => objects["objects/kind"]?.[k] === 1;

function drawVelocities(context, video, t, view, unit) {
  const { "states/position": position, "states/velocity": velocity } = video.arrays;
  if (!velocity) return;
  video.fastest ??= Math.max(1e-9, ...speeds(velocity));
  const scale = (0.22 * Math.min(video.width, video.height)) / video.fastest;
  for (let k = 0; k < video.objects.slot.length; k++) {
    const [vx, vy] = [at(velocity, t, k, 0, 2) * scale, at(velocity, t, k, 1, 2) * scale];
    if (Math.hypot(vx, vy) < 2 * unit) continue;
    const [cos, sin] = [Math.cos(view.angle), Math.sin(view.angle)];
    const [dx, dy] = [vx * cos + vy * sin, vx * sin - vy * cos];
    const [x, y] = view.point(at(position, t, k, 0, 2), at(position, t, k, 1, 2));
    const [toX, toY, direction, head] = [x + dx, y + dy, Math.atan2(dy, dx), 7 * unit];
    context.beginPath();
    context.moveTo(x, y);
    context.lineTo(toX, toY);
    for (const side of [2.6, -2.6]) {
      context.moveTo(toX, toY);
      context.lineTo(toX + head * Math.cos(direction + side), toY + head * Math.sin(direction + side));
    }
    halo(context, unit, "#fff", 2);
  }
}

function speeds(velocity) {
  const found = [];
  for (let i = 0; i < velocity.values.length; i += 2) found.push(Math.hypot(velocity.values[i], velocity.values[i + 1]));
  return found;
}

function drawContacts(context, video, t, view, unit) {
  const now = (t * video.stride) / data.fps;
  for (const [frame, , , px, py] of video.contacts || []) {
    const age = now - (Math.ceil(frame / video.stride) * video.stride) / data.fps;
    if (age < 0 || age > FLASH) continue;
    const [x, y] = view.point(px, py);
    const grown = 5 + 9 * Math.max(0, age / FLASH);
    context.beginPath();
    context.arc(x, y, grown * unit, 0, 2 * Math.PI);
    halo(context, unit, `rgb(255 214 80 / ${1 - 0.7 * Math.max(0, age / FLASH)})`, 2.5);
  }
}

function drawBoxes(context, video, t, unit) {
  const boxes = video.arrays["boxes/visible"];
  if (!boxes) return;
  for (let k = 0; k < video.objects.slot.length; k++) {
    const [left, top, right, bottom] = [0, 1, 2, 3].map((part) => at(boxes, t, k, part, 4));
    if (right <= left) continue;
    context.beginPath();
    context.rect(left, top, right - left, bottom - top);
    halo(context, unit, "#fff", 1.4);
  }
}

function drawNumbers(context, video, t, view, unit) {
  const position = video.arrays["states/position"];
  context.font = `600 ${12 * unit}px system-ui, sans-serif`;
  context.textAlign = "center";
  context.textBaseline = "middle";
  video.objects.slot.forEach((slot, k) => {
    const [x, y] = view.point(at(position, t, k, 0, 2), at(position, t, k, 1, 2));
    context.lineWidth = 3 * unit;
    context.strokeStyle = "rgb(0 0 0 / 70%)";
    context.strokeText(slot, x, y);
    context.fillStyle = "#fff";
    context.fillText(slot, x, y);
  });
}

function drawFrame(canvas, video, t, overlays) {
  const context = canvas.getContext("2d");
  const scale = canvas.width / video.width;
  context.setTransform(scale, 0, 0, canvas.height / video.height, 0, 0);
  const unit = (1 / scale) * Math.max(1, canvas.width / Math.max(1, canvas.clientWidth)); // one px of the screen
  const view = camera(video, t);
  context.imageSmoothingQuality = "high";
  if (video.sprite) {
    drawSprite(context, video, video.sprite, t);
  } else {
    context.clearRect(0, 0, video.width, video.height);
    if (video.objects) drawScene(context, video, t, view, unit);
  }
  if (overlays.has("Masks") && video.masks) {
    context.globalAlpha = 0.75;
    drawSprite(context, video, video.masks, t);
    context.globalAlpha = 1;
  }
  if (!video.objects) return;
  if (overlays.has("Boxes")) drawBoxes(context, video, t, unit);
  if (!view || !video.arrays["states/position"]) return;
  if (overlays.has("Trails")) drawTrails(context, video, t, view, unit);
  if (overlays.has("Outlines")) {
    const position = video.arrays["states/position"];
    for (let k = 0; k < video.objects.slot.length; k++) {
      const [x, y] = view.point(at(position, t, k, 0, 2), at(position, t, k, 1, 2));
      outline(context, video.objects, k, x, y, angleOf(video, t, k) - view.angle, view.scale);
      halo(context, unit, "#fff", 1.4);
    }
  }
  if (overlays.has("Velocities")) drawVelocities(context, video, t, view, unit);
  if (overlays.has("Contacts")) drawContacts(context, video, t, view, unit);
  if (overlays.has("Numbers")) drawNumbers(context, video, t, view, unit);
}

// What a video of this dataset has to be shown over its frames.
function available(name, video) {
  const needs = { Boxes: "boxes/visible", Velocities: "states/velocity" };
  if (name === "Contacts") return Boolean(video.contacts?.length);
  if (name === "Masks") return Boolean(video.masks);
  const seen = video.objects && "states/position" in video.arrays && "camera/scale" in video.arrays;
  return Boolean(video.objects && (needs[name] ? needs[name] in video.arrays : true) && (name === "Boxes" || seen));
}

// ---- The player

const clock = () => state.shown[0];
const stepsAt = (seconds, video) => Math.floor((seconds * data.fps) / video.stride + 1e-6);

function fit(canvas, video) {
  const width = Math.max(1, Math.round(canvas.clientWidth * Math.min(2, devicePixelRatio || 1)));
  const height = Math.max(1, Math.round((width * video.height) / video.width));
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
}

function draw() {
  const video = clock();
  if (!video) return;
  for (const shown of state.shown) {
    fit(shown.canvas, shown);
    drawFrame(shown.canvas, shown, Math.min(state.step, shown.count - 1), shows);
  }
  const frame = state.step * video.stride;
  const text = `frame ${frame} of ${video.frames}, ${(frame / data.fps).toFixed(3)} s`;
  $("clock").textContent = text;
  $("scrubber").value = state.step;
  $("scrubber").setAttribute("aria-valuetext", text);
  const now = $("plot").querySelector(".now");
  if (now) now.setAttribute("transform", `translate(${(560 * state.step) / Math.max(1, video.count - 1)} 0)`);
}

function drawEntry({ canvas, video }) {
  fit(canvas, video);
  drawFrame(canvas, video, stepsAt(state.time, video) % video.count, new Set());
}

const drawGallery = () => gallery.filter((entry) => entry.video && entry.visible).forEach(drawEntry);

function go(step) {
  const video = clock();
  if (!video) return;
  state.step = Math.min(Math.max(0, step), video.count - 1);
  state.time = (state.step * video.stride) / data.fps;
  draw();
  drawGallery();
}

let before = 0;
function tick(now) {
  if (!state.playing) return;
  const video = clock();
  state.time += (Math.min(now - before, 250) / 1000) * Number($("speed").value);
  before = now;
  const length = video ? (video.count * video.stride) / data.fps : 0;
  if (video && state.time >= length) state.time %= length;
  const step = video ? stepsAt(state.time, video) : 0;
  if (step !== state.step) {
    state.step = Math.min(step, video.count - 1);
    draw();
    drawGallery();
  }
  requestAnimationFrame(tick);
}

function play(playing) {
  state.playing = playing;
  $("play").textContent = playing ? "Pause" : "Play";
  before = performance.now();
  if (playing) requestAnimationFrame(tick);
}

async function select(split, number) {
  const serial = ++state.serial;
  const first = number - (number % data.members);
  const whole = data.members > 1 && $("whole-set").checked;
  const numbers = whole ? Array.from({ length: data.members }, (_, member) => first + member) : [number];
  const videos = [];
  for (const own of numbers.slice(0, 8)) {
    const video = await source.video(split, own);
    if (video) videos.push(video);
  }
  if (serial !== state.serial || !videos.length) return; // another was chosen meanwhile
  state.chosen = { split, number };
  const views = videos.map((video) => {
    const [width, height] = data.size;
    const canvas = element("canvas", { role: "img", width, height });
    const words = Object.values(captions(video))[0];
    canvas.setAttribute("aria-label", `${label(video)}${words ? `: ${words}` : ""}`);
    const named = "matched/member" in video.values ? memberName(video) : label(video);
    const figure = element("figure", {}, canvas, element("figcaption", {}, named));
    figure.style.maxWidth = `min(34rem, ${(65 * width) / height}vh)`;
    return [{ ...video, canvas }, figure];
  });
  state.shown = views.map(([video]) => video);
  state.focus = Math.max(0, state.shown.findIndex((video) => video.number === number));
  $("views").replaceChildren(...views.map(([, figure]) => figure));
  $("title").textContent = whole ? `Set ${first / data.members} of ${split}` : `Video ${number} of ${split}`;
  $("scrubber").max = clock().count - 1;
  for (const name of OVERLAYS) {
    const box = $(`show-${name}`);
    box.disabled = !state.shown.some((video) => available(name, video));
  }
  fillTimeline();
  fillTexts();
  fillValues();
  fillObjects();
  fillQuantities();
  for (const entry of gallery) {
    entry.button.setAttribute("aria-current", entry.split === split && entry.number === number);
  }
  go(Math.min(state.step, clock().count - 1));
}

function memberName(video) {
  const member = video.values["matched/member"];
  if (member === 0) return `${label(video)}: original`;
  const codes = (data.fields["matched/kind"]?.[1] || "").matchAll(/(\d+) (\w+)/g);
  const kinds = Object.fromEntries([...codes].map(([, code, name]) => [code, name.replaceAll("_", " ")]));
  const onset = video.values["matched/onset"];
  const from = onset >= 0 ? `, from frame ${onset}` : "";
  return `${label(video)}: ${kinds[video.values["matched/kind"]] || "changed"}${from}`;
}

function fillTimeline() {
  const lines = [];
  const video = state.shown[state.focus];
  const place = (frame) => (1000 * frame) / Math.max(1, (clock().count - 1) * clock().stride);
  const strongest = Math.max(1e-12, ...(video.contacts || []).map((contact) => contact[5]));
  for (const [frame, , , , , impulse] of video.contacts || []) {
    const x = place(frame);
    const top = 12 - 11 * Math.sqrt(Math.max(0.1, impulse / strongest));
    lines.push(drawing("line", { x1: x, x2: x, y1: top, y2: 12 }));
  }
  for (const shown of state.shown) {
    const onset = shown.values["matched/onset"];
    if (onset >= 0) lines.push(drawing("line", { x1: place(onset), x2: place(onset), y1: 0, y2: 12, class: "onset" }));
  }
  $("ticks").replaceChildren(...lines);
  const count = (video.contacts || []).length;
  $("ticks").setAttribute("aria-label", `${count} contact${count === 1 ? "" : "s"} of ${label(video)} on the time line`);
}

// ---- Values

const captions = (video) =>
  Object.fromEntries(Object.entries(video.values).filter(([name, value]) => name.startsWith("text/") && typeof value === "string" && value));

function shown(value) {
  if (Array.isArray(value)) return value.map((part) => (Array.isArray(part) ? `(${shown(part)})` : shown(part))).join(", ");
  return typeof value === "number" && !Number.isInteger(value) ? String(Number(value.toPrecision(4))) : String(value);
}

function fillTexts() {
  const texts = [];
  state.shown.forEach((video) => {
    for (const [name, text] of Object.entries(captions(video))) {
      const title = data.fields[name]?.[1] || name;
      texts.push(element("p", { title }, state.shown.length > 1 ? `${label(video)}: ${text}` : text));
    }
  });
  $("texts").replaceChildren(...texts.slice(0, 12));
}

function fillValues() {
  const names = Object.keys(state.shown[0].values).filter((name) => !name.startsWith("text/"));
  const isFactor = (name) => /^(factors|matched|ood_distance)\//.test(name) || name === "out_of_distribution";
  fillTable($("values"), names.filter(isFactor), "Factors");
  const others = names.filter((name) => !isFactor(name));
  fillTable($("others"), others, "Other values");
  $("others-box").hidden = !others.length;
}

function fillTable(table, names, title) {
  const rows = names.map((name) => {
    const [unit, meaning] = data.fields[name] || ["", ""];
    const cells = state.shown.map((video) => shown(video.values[name]));
    const heading = element("th", { scope: "row", title: meaning }, name.replace(/^factors\//, ""));
    if (unit && unit !== "1" && !name.endsWith(unit)) heading.append(" ", element("span", { class: "unit" }, unit));
    const kind = (cell) => (cell === cells[0] ? {} : { class: "differs" });
    const content = (cell, i) => (unit === "sRGB" ? chips(state.shown[i].values[name]) : [cell]);
    return element("tr", {}, heading, ...cells.map((cell, i) => element("td", kind(cell), ...content(cell, i))));
  });
  if (state.shown.length > 1 && rows.length) {
    const heads = state.shown.map((video) => element("th", { scope: "col" }, label(video)));
    rows.unshift(element("tr", {}, element("td"), ...heads));
  }
  table.replaceChildren(...(rows.length ? [element("caption", {}, title)] : []), ...rows);
}

// Spots of sRGB colours: one [red, green, blue], or several.
function chips(value) {
  if (!Array.isArray(value)) return [shown(value)];
  return (Array.isArray(value[0]) ? value : [value]).map((rgb) => chip(`rgb(${rgb.map(Number).join(" ")})`, shown(rgb)));
}

function chip(paint, name) {
  const spot = element("span", { class: "chip", title: name, role: "img", "aria-label": name });
  spot.style.background = paint;
  return spot;
}

function fillObjects() {
  const { objects } = state.shown[state.focus];
  $("objects-box").hidden = !objects;
  if (!objects) return;
  const names = Object.keys(objects).filter((name) => name.startsWith("objects/"));
  const unit = (name) => (data.fields[name][0] === "1" ? "" : ` ${data.fields[name][0]}`);
  const heads = ["slot", "shape", ...names.map((name) => name.slice(8) + unit(name))];
  const rows = objects.slot.map((slot, k) => {
    const spot = chip(color(objects, k), objects.color ? shown(objects.color[k]) : "");
    const cells = [objects.shape?.[k] || "", ...names.map((name) => shown(objects[name][k]))];
    return element("tr", {}, element("th", { scope: "row" }, spot, ` ${slot}`), ...cells.map((cell) => element("td", {}, cell)));
  });
  $("objects").replaceChildren(element("tr", {}, ...heads.map((head) => element("th", { scope: "col" }, head))), ...rows);
}

// ---- The plot

// Curves of a quantity: name, colour and a number for each frame.
function curves(video, quantity) {
  const range = Array.from({ length: video.count }, (_, t) => t);
  const { arrays, objects } = video;
  if (quantity === "energy") {
    const names = Object.keys(arrays).filter((name) => name.startsWith("energy/"));
    const found = names.map((name, i) => [name.slice(7).replaceAll("_", " "), CURVES[i], [...arrays[name].values]]);
    const mechanical = ["kinetic", "rotational", "potential"].map((name) => arrays[`energy/${name}`]).filter(Boolean);
    const total = range.map((t) => mechanical.reduce((sum, array) => sum + array.values[t], 0));
    return mechanical.length > 1 ? [...found, ["total mechanical", "var(--ink)", total]].slice(0, 7) : found;
  }
  if (quantity === "momentum") {
    const linear = arrays["momentum/linear"];
    return ["x", "y"].map((axis, part) => [axis, CURVES[part], range.map((t) => linear.values[2 * t + part])]);
  }
  const moving = objects.slot.map((_, k) => k).filter((k) => !fixed(objects, k));
  const position = arrays["states/position"];
  const velocity = arrays["states/velocity"];
  const value = {
    speed: (t, k) => Math.hypot(at(velocity, t, k, 0, 2), at(velocity, t, k, 1, 2)),
    x: (t, k) => at(position, t, k, 0, 2),
    y: (t, k) => at(position, t, k, 1, 2),
  }[quantity];
  return moving.map((k) => [`object ${objects.slot[k]}`, color(objects, k), range.map((t) => value(t, k))]);
}

function fillQuantities() {
  const { arrays, objects } = state.shown[state.focus];
  const names = [];
  if (Object.keys(arrays).some((name) => name.startsWith("energy/"))) names.push(["energy", "energy, J"]);
  if (objects && arrays["states/velocity"]) names.push(["speed", "speed, m/s"]);
  if (objects && arrays["states/position"]) names.push(["x", "position x, m"], ["y", "position y, m"]);
  if (arrays["momentum/linear"]) names.push(["momentum", "momentum, kg m/s"]);
  const old = $("quantity").value;
  $("quantity").replaceChildren(...names.map(([value, text]) => element("option", { value }, text)));
  if (names.some(([value]) => value === old)) $("quantity").value = old;
  $("chart").hidden = !names.length;
  if (names.length) fillPlot();
}

function fillPlot() {
  const video = state.shown[state.focus];
  const quantity = $("quantity").value;
  const own = curves(video, quantity);
  const others = state.shown.filter((other) => other !== video && other.objects).flatMap((other) => curves(other, quantity));
  const all = [...own, ...others].flatMap(([, , values]) => values).filter(Number.isFinite);
  let [low, high] = [Math.min(0, ...all), Math.max(0, ...all)];
  if (!all.length || low === high) [low, high] = [low - 1, high + 1];
  const place = (value) => 165 - (155 * (value - low)) / (high - low);
  const path = (values) =>
    values.map((value, t) => `${t ? "L" : "M"}${(70 + (560 * t) / Math.max(1, video.count - 1)).toFixed(1)} ${place(value).toFixed(1)}`).join("");
  const parts = [drawing("line", { x1: 70, x2: 630, y1: place(0), y2: place(0), class: "axis" })];
  for (const value of new Set([low, 0, high])) {
    parts.push(drawing("text", { x: 64, y: place(value) + 4, "text-anchor": "end" }, shown(Number(value.toPrecision(3)))));
  }
  const end = ((video.count - 1) * video.stride) / data.fps;
  parts.push(drawing("text", { x: 70, y: 184 }, "0 s"), drawing("text", { x: 630, y: 184, "text-anchor": "end" }, `${shown(end)} s`));
  for (const [, , values] of others) {
    parts.push(drawing("path", { d: path(values), stroke: "var(--soft)", "stroke-opacity": 0.45 }));
  }
  for (const [, stroke, values] of own) parts.push(drawing("path", { d: path(values), stroke }));
  parts.push(drawing("line", { x1: 70, x2: 70, y1: 8, y2: 168, class: "now" }));
  $("plot").replaceChildren(...parts);
  const words = $("quantity").selectedOptions[0]?.textContent;
  $("plot").setAttribute("aria-label", `${words} of ${label(video)}: from ${shown(low)} to ${shown(high)}`);
  $("legend").replaceChildren(
    ...own.slice(0, 12).map(([name, stroke]) => {
      const mark = element("i");
      mark.style.background = stroke;
      return element("span", {}, mark, name);
    }),
    ...(others.length ? [element("span", {}, "grey: the others of the set")] : []),
  );
  draw();
}

// ---- Where videos come from: this page, or the server of `gen2d view`

const opening = new Map();
const cached = (key, open) => {
  if (!opening.has(key)) opening.set(key, open());
  if (opening.size > 200) opening.delete(opening.keys().next().value);
  return opening.get(key);
};

async function ask(path) {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}

const inPage = {
  numeric: () => {
    const names = new Set();
    for (const video of data.videos) {
      for (const [name, value] of Object.entries(video.values)) if (typeof value === "number") names.add(name);
    }
    return [...names].filter((name) => name !== "index");
  },
  async list(split, rules) {
    const inside = (video) => rules.every(([name, low, high]) => video.values[name] >= low && video.values[name] <= high);
    const entries = data.videos.filter((video) => (!split || video.split === split) && inside(video));
    return { entries, total: entries.length, of: data.videos.length };
  },
  async video(split, number) {
    const video = data.videos.find((own) => own.split === split && own.number === number);
    return video && cached(label(video), () => opened(video));
  },
};

const onServer = {
  numeric: () => data.server.values,
  async list(split, rules, offset) {
    const query = new URLSearchParams({ split, offset, rules: JSON.stringify(rules.map((rule) => rule.map(String))) });
    const { numbers, total, of } = await ask(`videos?${query}`);
    return { entries: numbers.map((number) => ({ split, number })), total, of };
  },
  video: (split, number) =>
    cached(`${split} ${number}`, async () => {
      if (number >= data.splits[split]) return null;
      return opened(await ask(`video?${new URLSearchParams({ split, number })}`));
    }),
};

let source;

// ---- The gallery and its filters

let gallery = [];
const seen = new IntersectionObserver((changes) => {
  for (const { target, isIntersecting } of changes) {
    const entry = gallery.find((own) => own.canvas === target);
    if (entry) entry.visible = isIntersecting;
  }
  drawGallery();
});

function rules() {
  return [...$("rules").children].map((row) => {
    const [name, low, high] = row.querySelectorAll("select, input");
    const bound = (input, none) => (input.value === "" ? none : Number(input.value));
    return [name.value, bound(low, -Infinity), bound(high, Infinity)];
  });
}

let listing = 0;
async function refresh() {
  const serial = ++listing;
  $("count").textContent = "…";
  const { entries, total, of } = await source.list($("split").value, rules(), state.offset);
  if (serial !== listing) return;
  const videos = (count) => `${count.toLocaleString("en")} video${count === 1 ? "" : "s"}`;
  const range = data.server && entries.length ? `${state.offset + 1} to ${state.offset + entries.length} of ` : "";
  $("count").textContent = `${range}${videos(total)}${total === of ? "" : `, of ${of.toLocaleString("en")}`}`;
  $("previous").disabled = !state.offset;
  $("next").disabled = !data.server || state.offset + entries.length >= total;
  seen.disconnect();
  gallery = entries.map(({ split, number }) => {
    const [width, height] = data.size;
    const canvas = element("canvas", { "aria-hidden": "true", width, height });
    const button = element("button", { type: "button" }, canvas, element("span", {}, `${split} ${number}`));
    button.addEventListener("click", () => {
      select(split, number).catch(complain);
      $("player").scrollIntoView({ block: "nearest" });
    });
    return { split, number, canvas, button, visible: true };
  });
  const { chosen } = state;
  $("gallery").replaceChildren(...gallery.map(({ button }) => element("li", {}, button)));
  for (const entry of gallery) {
    entry.button.setAttribute("aria-current", chosen?.split === entry.split && chosen?.number === entry.number);
    seen.observe(entry.canvas);
  }
  await Promise.all(
    gallery.map(async (entry) => {
      entry.video = await source.video(entry.split, entry.number);
      if (entry.video && gallery.includes(entry)) drawEntry(entry);
    }),
  );
}

function addRule() {
  const names = source.numeric();
  const choice = element("select", { "aria-label": "Value" }, ...names.map((name) => element("option", { value: name }, name)));
  const bound = (name) => element("input", { type: "number", step: "any", placeholder: name, "aria-label": name });
  const remove = element("button", { type: "button", "aria-label": "Remove the filter" }, "×");
  const row = element("div", {}, choice, " from ", bound("least"), " to ", bound("largest"), " ", remove);
  remove.addEventListener("click", () => {
    row.remove();
    restart();
  });
  row.addEventListener("change", restart);
  $("rules").append(row);
}

function restart() {
  state.offset = 0;
  refresh().catch(complain);
}

// ---- The keyboard

function neighbour(offset) {
  const place = gallery.findIndex((entry) => entry.button.getAttribute("aria-current") === "true");
  const entry = gallery[place + offset];
  if (entry) select(entry.split, entry.number).catch(complain);
}

document.addEventListener("keydown", (event) => {
  const typing = event.target.matches("input[type=number], select, textarea");
  if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
  const onButton = event.target.matches("button, summary, input[type=checkbox]");
  const far = event.shiftKey ? 10 : 1;
  const actions = {
    ArrowLeft: () => go(state.step - far),
    ArrowRight: () => go(state.step + far),
    Home: () => go(0),
    End: () => go(Infinity),
    j: () => neighbour(1),
    k: () => neighbour(-1),
  };
  if (event.key === " " && !onButton) actions[" "] = () => play(!state.playing);
  OVERLAYS.forEach((name, i) => (actions[i + 1] = () => $(`show-${name}`).click()));
  const action = actions[event.key] || actions[event.key.toLowerCase()];
  if (!action) return;
  event.preventDefault();
  if (event.key.startsWith("Arrow") || event.key === "Home" || event.key === "End") play(false);
  action();
});

// ---- Start

function themed(dark) {
  document.documentElement.dataset.theme = dark ? "dark" : "light";
  $("theme").textContent = dark ? "Light" : "Dark";
}

async function start() {
  data = JSON.parse(new TextDecoder().decode(await inflated($("data").textContent)));
  source = data.server ? onServer : inPage;
  const isDark = matchMedia("(prefers-color-scheme: dark)").matches;
  $("theme").textContent = isDark ? "Light" : "Dark";
  $("theme").addEventListener("click", () => themed($("theme").textContent === "Dark"));
  for (const name of OVERLAYS) {
    const box = element("input", { type: "checkbox", id: `show-${name}` });
    box.addEventListener("change", () => {
      if (box.checked) shows.add(name);
      else shows.delete(name);
      draw();
    });
    $("overlays").append(element("label", {}, box, ` ${name}`));
  }
  const splits = Object.keys(data.splits);
  const all = data.server ? [] : [element("option", { value: "" }, "all")];
  $("split").append(...all, ...splits.map((name) => element("option", { value: name }, name)));
  $("split-choice").hidden = splits.length === 1;
  $("set-choice").hidden = data.members === 1;
  $("pager").hidden = !data.server;
  $("add").hidden = !source.numeric().length;
  $("add").addEventListener("click", addRule);
  $("split").addEventListener("change", restart);
  $("filters").addEventListener("submit", (event) => event.preventDefault());
  for (const [id, sign] of [["previous", -1], ["next", 1]]) {
    $(id).addEventListener("click", () => {
      state.offset = Math.max(0, state.offset + sign * data.server.most);
      refresh().catch(complain);
    });
  }
  $("scrubber").addEventListener("input", () => {
    play(false);
    go(Number($("scrubber").value));
  });
  $("play").addEventListener("click", () => play(!state.playing));
  $("quantity").addEventListener("change", fillPlot);
  $("whole-set").addEventListener("change", () => select(state.chosen.split, state.chosen.number).catch(complain));
  addEventListener("resize", () => {
    draw();
    drawGallery();
  });
  const first = data.videos[0] || { split: data.server?.first, number: 0 };
  if (data.server) $("split").value = first.split;
  if (!first.split) {
    $("problem").textContent = "This dataset has no videos that the page can show.";
    $("problem").hidden = false;
    return;
  }
  document.querySelector("main").hidden = false;
  await select(first.split, first.number);
  performance.mark("first frame");
  await refresh();
  document.documentElement.dataset.complete = "true";
  if (!matchMedia("(prefers-reduced-motion: reduce)").matches) play(true);
}

start().catch(complain);
