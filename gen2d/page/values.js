// Texts, tables of values and objects, and the plot.

// ---- Tables

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

// Whether a factor's colours are none of the objects' in any of these videos, as with a look's own palette.
function replaced(name) {
  const isColor = name.startsWith("factors/") && data.fields[name]?.[0] === "sRGB";
  const none = ({ values, objects }) => {
    const found = values[name];
    const seen = new Set((objects?.color || []).map(String));
    return seen.size && Array.isArray(found) && ![found, ...found].some((rgb) => seen.has(String(rgb)));
  };
  return isColor && state.shown.every(none);
}

// The distinct colours of the objects that move.
function moving(video) {
  const { objects } = video;
  const own = (objects?.color || []).filter((_, k) => !fixed(objects, k));
  return [...new Map(own.map((rgb) => [String(rgb), rgb])).values()];
}

function fillValues() {
  const names = Object.keys(state.shown[0].values).filter((name) => !name.startsWith("text/") && name !== "objects/color");
  const known = (name) => /^(factors|matched|ood_distance)\//.test(name) || name === "out_of_distribution";
  const isFactor = (name) => known(name) && !replaced(name);
  const factors = names.filter(isFactor);
  if (names.some(replaced)) {
    for (const video of state.shown) video.values["objects/color"] = moving(video);
    factors.push("objects/color");
  }
  fillTable($("values"), factors, "Factors");
  const others = names.filter((name) => !isFactor(name));
  fillTable($("others"), others, "Other values");
  $("others-box").hidden = !others.length;
}

function fillTable(table, names, title) {
  const rows = names.map((name) => {
    const [unit, meaning] = data.fields[name] || ["", ""];
    const cells = state.shown.map((video) => shown(video.values[name]));
    const heading = element("th", { scope: "row", title: meaning }, name.replace(/^factors\//, replaced(name) ? "not drawn: " : "").replace("objects/color", "colors drawn"));
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
