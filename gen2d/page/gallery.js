// The gallery with its filters, where videos come from, the keyboard, and the start.

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
  Object.keys(OVERLAYS).forEach((name, i) => (actions[KEYS[i]] = () => $(`show-${name}`).click()));
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
  for (const [i, [name, field]] of Object.entries(OVERLAYS).entries()) {
    const key = KEYS[i];
    const box = element("input", { type: "checkbox", id: `show-${name}`, "aria-keyshortcuts": key });
    box.addEventListener("change", () => {
      if (box.checked) shows.add(name);
      else shows.delete(name);
      draw();
    });
    const choice = element("label", { title: `key ${key}` }, box, ` ${name}`);
    choice.hidden = Boolean(field) && !(field in data.fields);
    $("overlays").append(choice);
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
