// The player: the chosen video or its set, playing, and the time line.

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
  // The browser's first frame may have begun before the video was started.
  const passed = Math.max(0, Math.min(now - before, 250));
  state.time += (passed / 1000) * Number($("speed").value);
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
  for (const name of Object.keys(OVERLAYS)) {
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
