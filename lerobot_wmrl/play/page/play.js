// The page's clock runs here: each step is one message to the world model and one answer. What changes the drive
// goes through `inTurn`, one after the other. The world model runs in a server (server.js) or in this browser
// (local.js).

const $ = (id) => document.getElementById(id);
const sleep = (milliseconds) => new Promise((done) => setTimeout(done, milliseconds));
const YOU = "you";
const KEYS = [
  ["ArrowLeft", "ArrowRight"], ["ArrowDown", "ArrowUp"], ["KeyQ", "KeyE"], ["KeyA", "KeyD"], ["KeyZ", "KeyC"],
  ["KeyJ", "KeyL"], ["KeyG", "KeyH"], ["KeyK", "KeyI"], ["KeyV", "KeyB"], ["KeyN", "KeyM"], ["KeyT", "KeyY"],
  ["KeyU", "KeyO"],
];
const SECONDS_ACROSS = 1.5; // that a held key takes to move an axis across its range
const COLOURS = { you: "#1f6feb", policy: "#8250df", planner: "#bc4c00", recorded: "#57606a" };

let ask, upload; // of the module in which the world model runs
let world; // what it says of itself
let axes = []; // of an action, with the keys and values of this page
let views = []; // frames of the drive
let begun = null; // how the drive began
let shown = 0; // the frame that is looked at
let driver = YOU;
let playing = false;
let rates = []; // times of the last steps
const down = new Set(); // keys held down
const pad = { x: 0, y: 0, held: false };

let turn = Promise.resolve();

function inTurn(act) {
  const done = turn.then(act);
  turn = done.catch(() => {});
  return done;
}

function say(message) {
  const failed = message instanceof Error;
  $("status").textContent = failed ? message.message : message;
  $("status").classList.toggle("error", failed);
  if (failed) setPlaying(false);
}

// ---- the drive ---------------------------------------------------------------------------------------------

async function restore() {
  const answer = await ask({ do: "resume" });
  if (answer.begun) adopt(answer);
  else if (begun) await replay({ place: begun.place, actions: views.slice(1).map((view) => view.action) });
  else if (location.hash.length > 1) await replay(linked());
  else await begin(firstPlace());
  say("ready");
}

function adopt(answer) {
  ({ begun, views } = answer);
  shown = views.length - 1;
  resetAxes();
  showBeginning();
  draw();
}

async function begin(place) {
  setPlaying(false);
  say("beginning…");
  adopt(await ask({ ...place, do: "begin" }));
  say("ready");
}

const linked = () => JSON.parse(decodeURIComponent(location.hash.slice(1)));

async function replay({ place, actions }) {
  await begin(place);
  setDriver(YOU);
  say("replaying…");
  for (const action of actions) {
    const answer = await ask({ do: "step", driver: YOU, action });
    views.push(answer.view);
    shown = views.length - 1;
    draw();
    await sleep(1000 / world.fps);
  }
}

async function step() {
  if (shown < views.length - 1) await rewind(shown);
  const sent = performance.now(), at = shown;
  const message = { do: "step", driver };
  if (driver === YOU) message.action = nextAction();
  const answer = await ask(message);
  views.push(answer.view);
  if (message.driver !== YOU) follow(answer.view.action);
  if (shown === at) shown = views.length - 1; // else somebody has looked elsewhere meanwhile
  draw();
  rates.push([performance.now(), performance.now() - sent]);
  rates = rates.slice(-30);
  if (answer.view.ended || (driver === "recorded" && shown >= begun.recorded)) setPlaying(false);
}

async function rewind(frame) {
  await ask({ do: "rewind", frame });
  views = views.slice(0, frame + 1);
  shown = frame;
  resetAxes();
}

async function run() {
  let due = performance.now();
  for (;;) {
    if (!playing) { await sleep(15); due = performance.now(); continue; }
    try { await inTurn(step); } catch (error) { say(error); }
    due = Math.max(due + 1000 / world.fps, performance.now() - 100);
    await sleep(Math.max(0, due - performance.now()));
  }
}

async function save(success) {
  setPlaying(false);
  if (shown < views.length - 1) await rewind(shown);
  const answer = await ask({ do: "save", success });
  $("saved").textContent =
    `episode ${answer.saved} (${answer.success ? "success" : "failure"}) is in ${answer.folder}`;
}

function setPlaying(on) {
  playing = on;
  $("play").textContent = on ? "❚❚ pause" : "▶ play";
}

function setDriver(name) {
  driver = name;
  for (const button of $("drivers").children) button.setAttribute("aria-pressed", button.value === name);
}

// ---- your actions ------------------------------------------------------------------------------------------

function resetAxes() {
  const action = views[shown].action;
  const recorded = shown === 0 && begun.action.length ? begun.action : action;
  axes.forEach((axis, index) => {
    axis.value = axis.springs || !recorded.length ? axis.rest : recorded[index];
  });
  drawAxes();
}

// Axes that are held go on from where somebody else has left them.
function follow(action) {
  axes.forEach((axis, index) => { if (!axis.springs) axis.value = action[index]; });
  drawAxes();
}

function nextAction() {
  const speed = Number($("speed").value);
  const pads = [[$("pad-x").value, pad.x], [$("pad-y").value, pad.y]];
  const sticks = [...([...(navigator.getGamepads?.() ?? [])].find((each) => each)?.axes ?? [])];
  [1, 3].forEach((up) => { sticks[up] = -(sticks[up] ?? 0); }); // a stick that is pushed away is negative
  axes.forEach((axis, index) => {
    const stick = index < 4 && Math.abs(sticks[index] ?? 0) > 0.15 ? sticks[index] : 0;
    let push = (down.has(axis.keys[1]) - down.has(axis.keys[0])) * speed + stick;
    const dragged = pad.held && pads.find(([chosen]) => chosen === String(index));
    const half = (axis.high - axis.low) / 2;
    if (axis.springs) {
      if (dragged) push = dragged[1];
      axis.value = axis.slid ?? axis.rest + push * half;
      if (!axis.sliding) axis.slid = null;
    } else if (dragged) {
      axis.value = axis.low + half + dragged[1] * half;
    } else {
      axis.value += push * 2 * half / (SECONDS_ACROSS * world.fps);
    }
    axis.value = Math.min(axis.high, Math.max(axis.low, axis.value));
  });
  drawAxes();
  return axes.map((axis) => axis.value);
}

function takeOver() {
  setDriver(YOU);
  if (!playing && !views.at(-1)?.ended) setPlaying(true);
  else if (!playing && shown < views.length - 1) setPlaying(true);
}

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const target = event.target;
  if (/^(text|number|select-one)$/.test(target.type ?? "")) return;
  if (event.code === "Space" && /^(button|submit|checkbox)$/.test(target.type ?? "")) return; // its own
  const rebinding = document.querySelector("kbd.waiting");
  if (rebinding) { rebind(rebinding, event.code); event.preventDefault(); return; }
  if (axes.some((axis) => axis.keys.includes(event.code))) {
    event.preventDefault();
    down.add(event.code);
    if (!event.repeat) takeOver();
    drawKeys();
    return;
  }
  const act = {
    Space: () => setPlaying(!playing), Period: oneStep, Comma: () => look(shown - 1), KeyR: restart,
    ...(world.saves && { KeyS: () => inTurn(() => save(true)), KeyF: () => inTurn(() => save(false)) }),
  }[event.code] ?? chosenDriver(event.code);
  if (!act) return;
  event.preventDefault();
  if (!event.repeat) Promise.resolve(act()).catch(say);
}

function chosenDriver(code) {
  const button = /^Digit[1-9]$/.test(code) && $("drivers").children[Number(code.slice(5)) - 1];
  return button && (() => setDriver(button.value));
}

function rebind(key, code) {
  const [index, end] = key.dataset.key.split(",").map(Number);
  axes.forEach((axis) => { axis.keys = axis.keys.map((each) => (each === code ? "" : each)); });
  axes[index].keys[end] = code;
  key.classList.remove("waiting");
  drawKeys();
}

const oneStep = () => { setPlaying(false); return inTurn(step); };
const restart = () => { setPlaying(false); return inTurn(async () => { await rewind(0); draw(); }); };

function look(frame) {
  setPlaying(false);
  shown = Math.min(views.length - 1, Math.max(0, frame));
  draw();
}

// ---- what is shown -----------------------------------------------------------------------------------------

function build() {
  $("views").classList.toggle("single", world.cameras.length === 1);
  const rows = [["imagined", "imagined"], ["beside", ""], ["difference", "difference"]];
  for (const [kind, title] of rows) {
    const strip = element("div", { className: "strip", id: `strip-${kind}` });
    world.cameras.forEach((camera) => {
      const picture = element(kind === "difference" ? "canvas" : "img", kind === "difference" ? {} : { alt: "" });
      const caption = element("figcaption", {}, element("span", {}, title), `: ${camera}`);
      strip.append(element("figure", {}, picture, caption));
    });
    $("views").append(strip);
  }
  $("difference-field").hidden = !world.compares;
  $("episode-frame").parentElement.hidden = world.first_frames;
  for (const id of ["save-success", "save-failure", "save"]) $(id).hidden = !world.saves;
  if (!world.saves) $("saved").textContent = "A link replays what was driven.";

  const drivers = [YOU, ...world.drivers];
  drivers.forEach((name, index) => {
    const label = name === "policy" ? `policy (${world.policy})` : name;
    const button = element("button", { value: name, title: `key ${index + 1}` }, label);
    button.onclick = () => setDriver(name);
    $("drivers").append(button);
  });
  setDriver(YOU);

  axes = world.axes.map((axis, index) => ({ ...axis, value: axis.rest, keys: [...(KEYS[index] ?? ["", ""])] }));
  axes.forEach((axis, index) => {
    const slider = element("input", { type: "range", min: axis.low, max: axis.high, step: "any" });
    slider.setAttribute("aria-label", axis.name);
    slider.onpointerdown = () => { axis.sliding = true; };
    slider.onpointerup = slider.onpointercancel = () => { axis.sliding = false; };
    slider.oninput = () => { axis.value = axis.slid = Number(slider.value); setDriver(YOU); };
    const holds = element("input", { type: "checkbox", checked: !axis.springs });
    holds.onchange = () => { axis.springs = !holds.checked; };
    const keys = [0, 1].map((end) => {
      const key = element("kbd", { title: "click to choose another key" });
      key.dataset.key = `${index},${end}`;
      key.onclick = () => {
        document.querySelectorAll("kbd.waiting").forEach((each) => each !== key && each.classList.remove("waiting"));
        key.classList.toggle("waiting");
        drawKeys();
      };
      return key;
    });
    $("axes").append(element("div", { className: "axis" },
      element("span", {}, axis.name), element("span", { className: "keys" }, ...keys), slider,
      element("label", { title: "stays where it is when released" }, holds, " hold")));
  });
  drawKeys();
  for (const [id, chosen] of [["pad-x", 0], ["pad-y", Math.min(1, axes.length - 1)]]) {
    axes.forEach((axis, index) => $(id).append(element("option", { value: index }, axis.name)));
    $(id).value = chosen;
  }

  const places = [["episode", world.episodes.length], ["seed", world.real], ["picture", true]];
  for (const [name] of places.filter(([, there]) => there)) {
    const tab = element("button", { role: "tab", type: "button", value: name }, name);
    tab.onclick = () => showPlace(name);
    $("places").append(tab);
  }
  world.cameras.forEach((camera) => $("picture-files").append(
    element("label", {}, `${camera} `, element("input", { type: "file", name: camera, accept: "image/*" }))));
  $("picture-state-field").hidden = !world.state.length;
  $("picture-state").placeholder = world.state.join(", ");
  $("episode").max = world.episodes.length - 1;
  showPlace(world.episodes.length ? "episode" : "seed");
  describeEpisode();
}

function element(kind, properties, ...children) {
  const made = Object.assign(document.createElement(kind), properties);
  if (properties.role) made.setAttribute("role", properties.role);
  made.append(...children);
  return made;
}

function firstPlace() {
  return world.episodes.length ? { episode: 0, frame: 0 } : { seed: 0 };
}

function showPlace(name) {
  for (const each of ["episode", "seed", "picture"]) $(`place-${each}`).hidden = each !== name;
  for (const tab of $("places").children) tab.setAttribute("aria-selected", tab.value === name);
}

function describeEpisode() {
  const episode = world.episodes[$("episode").value];
  if (!episode) return;
  const outcome = { true: ", a success", false: ", a failure" }[episode.success] ?? "";
  $("episode-note").textContent = `${episode.length} frames${outcome}: ${episode.task}`;
  $("episode-frame").max = episode.length - 1;
}

function showBeginning() {
  $("goal").hidden = !begun.goal.length;
  $("goal").querySelector(".images").replaceChildren(
    ...begun.goal.map((source) => element("img", { src: source, alt: "goal frame" })));
  for (const button of $("drivers").children) button.disabled = button.value === "recorded" && !begun.recorded;
  if (driver === "recorded" && !begun.recorded) setDriver(YOU);
}

function draw() {
  const view = views[shown];
  fill("strip-imagined", view.images);
  fill("strip-beside", view.beside?.images ?? [], view.beside?.name);
  drawDifference();
  $("counter").textContent = `frame ${shown} (${(shown / world.fps).toFixed(1)} s)`;
  $("timeline").max = views.length - 1;
  $("timeline").value = shown;
  drawMeters(view);
  drawCurve();
  const over = { success: "Success: the episode has ended. Go back, or restart.", end: "The episode is over." };
  const beside = { success: "has succeeded.", end: "has ended." }[view.beside?.ended];
  const text = [over[view.ended], beside && `${view.beside.name} ${beside}`].filter(Boolean).join(" ");
  $("banner").hidden = !text;
  $("banner").textContent = text;
  $("banner").classList.toggle("success", view.ended === "success");
}

function fill(id, images, title) {
  const strip = $(id);
  strip.hidden = !images.length;
  if (title) strip.querySelectorAll("span").forEach((span) => { span.textContent = title; });
  [...strip.querySelectorAll("img")].forEach((image, index) => { if (images[index]) image.src = images[index]; });
}

function drawDifference() {
  const strip = $("strip-difference"), view = views[shown];
  strip.hidden = !$("difference").checked || !view.beside;
  if (strip.hidden) return;
  const load = async (source) => createImageBitmap(await (await fetch(source)).blob());
  [...strip.querySelectorAll("canvas")].forEach(async (canvas, index) => {
    const [imagined, real] = await Promise.all([load(view.images[index]), load(view.beside.images[index])]);
    if (views[shown] !== view) return;
    Object.assign(canvas, { width: imagined.width, height: imagined.height });
    const context = canvas.getContext("2d");
    context.drawImage(imagined, 0, 0);
    context.globalCompositeOperation = "difference";
    context.drawImage(real, 0, 0, imagined.width, imagined.height);
  });
}

function drawMeters(view) {
  const measured = view.measured;
  const steps = rates.length > 1 ? 1000 * (rates.length - 1) / (rates.at(-1)[0] - rates[0][0]) : 0;
  const rows = [
    ...(world.knows_success ? [["success probability", measured.done_probability, 1, world.done_threshold]] : []),
    ["uncertainty (nats)", measured.token_entropy],
    ...(world.knows_success ? [["reward", measured.reward]] : []),
    ...(world.goal ? [["similarity to the goal", measured.similarity, 1]] : []),
    ["action clipped", measured.clipped, 1],
    ["frames a second", steps],
    ["answer (ms)", rates.at(-1)?.[1]],
  ];
  $("meters").replaceChildren(...rows.flatMap(([name, value, most]) => [
    element("dt", {}, name),
    element("dd", { className: "bar" }, ...(most && value !== undefined ? [element("meter", { max: most, value })] : [])),
    element("dd", {}, value === undefined ? "–" : value.toPrecision(3)),
  ]));
}

function drawCurve() {
  const canvas = $("curve"), context = canvas.getContext("2d");
  const width = canvas.width = canvas.clientWidth, height = canvas.height;
  const last = Math.max(views.length - 1, world.clip_length);
  const x = (frame) => (frame / last) * (width - 2) + 1;
  const y = (share) => 4 + (1 - share) * (height - 16);
  context.clearRect(0, 0, width, height);
  views.slice(1).forEach((view, index) => {
    context.fillStyle = COLOURS[view.driver];
    context.fillRect(x(index), height - 8, Math.max(1, x(index + 1) - x(index)), 6);
    if (!world.knows_success) return;
    context.globalAlpha = view.measured.done_probability >= world.done_threshold ? 1 : 0.45;
    context.fillRect(x(index), y(view.measured.done_probability), Math.max(1, x(index + 1) - x(index)), 2);
    context.globalAlpha = 1;
  });
  context.fillStyle = "#8888";
  if (views.length - 1 > world.clip_length) context.fillRect(x(world.clip_length), 0, 1, height);
  context.fillStyle = "#d33";
  context.fillRect(x(shown) - 1, 0, 2, height);
  $("curve-note").textContent = views.length - 1 > world.clip_length
    ? `Right of the grey line it is longer than the ${world.clip_length} frames that the world model has learnt from.`
    : "";
}

function drawAxes() {
  [...$("axes").querySelectorAll("input[type=range]")].forEach((slider, index) => {
    slider.value = axes[index].value;
  });
}

function drawKeys() {
  for (const key of document.querySelectorAll("kbd")) {
    const [index, end] = key.dataset.key.split(",").map(Number);
    const code = axes[index].keys[end];
    key.textContent = key.classList.contains("waiting") ? "?" : code.replace("Key", "").replace("ArrowLeft", "←")
      .replace("ArrowRight", "→").replace("ArrowDown", "↓").replace("ArrowUp", "↑") || "–";
    key.classList.toggle("down", down.has(code));
  }
}

// ---- buttons, keys, pad ------------------------------------------------------------------------------------

function listen() {
  const on = (id, act) => { $(id).onclick = (event) => Promise.resolve(act(event)).catch(say); };
  on("play", () => setPlaying(!playing));
  on("back", () => look(shown - 1));
  on("next", oneStep);
  on("restart", restart);
  on("save-success", () => inTurn(() => save(true)));
  on("save-failure", () => inTurn(() => save(false)));
  on("save", () => inTurn(() => save(null)));
  on("link", copyLink);
  $("timeline").oninput = () => look(Number($("timeline").value));
  $("difference").onchange = drawDifference;
  $("episode").oninput = describeEpisode;
  submit("place-episode", () => begin(
    withTask({ episode: Number($("episode").value), frame: Number($("episode-frame").value) })));
  submit("place-seed", () => begin(withTask({ seed: Number($("seed").value) })));
  submit("place-picture", beginInPictures);
  addEventListener("keydown", onKey);
  // A button that was clicked by the mouse would take the keys from then on.
  addEventListener("click", (event) => { if (event.detail) event.target.closest?.("button")?.blur(); });
  addEventListener("hashchange", () => { if (location.hash.length > 1) inTurn(() => replay(linked())).catch(say); });
  addEventListener("keyup", (event) => { down.delete(event.code); drawKeys(); });
  addEventListener("blur", () => { down.clear(); drawKeys(); });
  addEventListener("resize", drawCurve);
  $("pad").onpointerdown = (event) => { $("pad").setPointerCapture(event.pointerId); drag(event); takeOver(); };
  $("pad").onpointermove = (event) => { if (pad.held) drag(event); };
  $("pad").onpointerup = $("pad").onpointercancel = () => {
    Object.assign(pad, { x: 0, y: 0, held: false });
    $("pad").firstElementChild.style.translate = "";
  };
}

function submit(id, act) {
  $(id).onsubmit = (event) => { event.preventDefault(); inTurn(act).catch(say); };
}

const withTask = (place) => {
  const instruction = $("instruction").value.trim();
  return instruction ? { ...place, instruction } : place;
};

function drag(event) {
  const box = $("pad").getBoundingClientRect();
  const share = (at, from, size) => Math.min(1, Math.max(-1, 2 * (at - from) / size - 1));
  const x = share(event.clientX, box.left, box.width), y = share(event.clientY, box.top, box.height);
  Object.assign(pad, { x, y: -y, held: true });
  $("pad").firstElementChild.style.translate = `${x * box.width / 2}px ${y * box.height / 2}px`;
}

async function beginInPictures() {
  const form = new FormData($("place-picture"));
  form.append("instruction", $("instruction").value);
  if (world.state.length) form.append("state", `[${$("picture-state").value}]`);
  await begin(await upload(form));
}

async function copyLink() {
  if ("picture" in begun.place) throw new Error("a drive that begins in an uploaded picture has no link");
  const actions = views.slice(1, shown + 1).map((view) => view.action.map((each) => Number(each.toPrecision(9))));
  const url = new URL(location.href);
  url.searchParams.delete("token"); // it admits whoever has the link; this browser has a cookie
  url.hash = encodeURIComponent(JSON.stringify({ place: begun.place, actions }));
  history.replaceState(null, "", url);
  await navigator.clipboard?.writeText(url.href).catch(() => {});
  $("saved").textContent = "The link is in the address bar and, where the browser allows it, in the clipboard.";
}

async function main() {
  const model = await import(document.body.dataset.world).catch((error) => {
    throw new Error(`the world model cannot be loaded (${error.message}); open the page from a web server`);
  });
  ({ ask, upload } = model);
  world = await model.describe();
  build();
  listen();
  model.connect(() => inTurn(restore).catch(say), say);
  run();
}

main().catch(say);
