// Frames and what is shown over them, on a canvas.

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
  const occluders = [...(video.occluders || [])];
  const drawOccluders = (before) => {
    while (occluders.length && occluders[0][7] <= before) {
      const [left, top, right, bottom, ...paint] = occluders.shift();
      context.fillStyle = `rgb(${paint.slice(0, 3).join(" ")})`;
      context.fillRect(left, top, right - left, bottom - top);
    }
  };
  for (const k of order) {
    if (depth) drawOccluders(depth[k]);
    const [x, y] = view.point(at(position, t, k, 0, 2), at(position, t, k, 1, 2));
    outline(context, video.objects, k, x, y, angleOf(video, t, k) - view.angle, view.scale);
    context.fillStyle = context.strokeStyle = color(video.objects, k);
    context.lineWidth = 2 * unit;
    context.fill();
    context.stroke();
  }
  drawOccluders(Infinity);
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

// Flow to the next frame, and the wheel of its colours, which are those of `directions` in gen2d/media/overlays.py.
function drawFlow(context, video, t, unit) {
  drawSprite(context, video, video.flow, t);
  const radius = Math.min(18 * unit, 0.12 * Math.min(video.width, video.height));
  const [x, y] = [video.width - 1.3 * radius, 1.3 * radius];
  for (let degrees = 0; degrees < 360; degrees += 10) {
    const from = ((degrees - 5) * Math.PI) / 180;
    context.beginPath();
    context.moveTo(x, y);
    context.arc(x, y, radius, from, from + (10.5 * Math.PI) / 180);
    context.fillStyle = `hsl(${degrees} 100% 50%)`;
    context.fill();
  }
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
  for (const name of ["Depth", "Normals", "Shadow"]) {
    if (overlays.has(name) && video[LAYERS[name]]) drawSprite(context, video, video[LAYERS[name]], t);
  }
  if (overlays.has("Masks") && video.masks) {
    context.globalAlpha = 0.75;
    drawSprite(context, video, video.masks, t);
    context.globalAlpha = 1;
  }
  if (overlays.has("Flow") && video.flow) drawFlow(context, video, t, unit);
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
  if (name === "Contacts") return Boolean(video.contacts?.length);
  if (name in LAYERS) return Boolean(video[LAYERS[name]]);
  const seen = video.objects && "states/position" in video.arrays && "camera/scale" in video.arrays;
  return Boolean(video.objects && (!OVERLAYS[name] || OVERLAYS[name] in video.arrays) && (name === "Boxes" || seen));
}
