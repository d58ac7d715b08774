// Labels are sent one by one, as they are made; the server keeps them in a file.

const $ = (id) => document.getElementById(id);
const sleep = (milliseconds) => new Promise((done) => setTimeout(done, milliseconds));
const NONE = "none"; // an episode without a label
const token = new URLSearchParams(location.search).get("token");
const query = (fields) => new URLSearchParams(token ? { ...fields, token } : fields).toString();

let dataset; // what the server says of it
let labels = new Map(); // episode → first solved frame, null for a failure
let episode = 0, frame = 0, playing = false;
const past = []; // [episode, label before]

function say(message) {
  const failed = message instanceof Error;
  $("status").textContent = failed ? message.message : message;
  $("status").classList.toggle("error", failed);
}

async function post(path, content) {
  const response = await fetch(`${path}?${query({})}`, {
    method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(content),
  });
  if (!response.ok) throw new Error(await response.text());
}

const labelOf = (index) => (labels.has(index) ? labels.get(index) : NONE);

let sending = Promise.resolve();

// Labels are shown at once and sent one after the other; one that is refused is taken back.
function put(index, first) {
  const before = labelOf(index);
  set(index, first);
  sending = sending.then(() => post("label", { episode: index, first })).catch((error) => {
    set(index, before);
    open(index);
    say(error);
  });
}

function set(index, first) {
  if (first === NONE) labels.delete(index); else labels.set(index, first);
}

function mark(first) {
  const index = episode, count = dataset.lengths.length;
  past.push([index, labelOf(index)]);
  put(index, first);
  const following = [...Array(count).keys()].map((step) => (index + 1 + step) % count);
  open(following.find((each) => !labels.has(each)) ?? index);
}

function undo() {
  if (!past.length) return;
  const [index, before] = past.pop();
  put(index, before);
  open(index);
}

function open(index) {
  episode = Math.min(dataset.lengths.length - 1, Math.max(0, index));
  playing = false;
  look(0);
  draw();
}

function look(at) {
  frame = Math.min(dataset.lengths[episode] - 1, Math.max(0, at));
  [...$("frames").querySelectorAll("img")].forEach((image, index) => {
    image.src = `frame?${query({ episode, frame, camera: dataset.cameras[index] })}`;
  });
  $("timeline").value = frame;
  $("counter").textContent = `frame ${frame} of ${dataset.lengths[episode] - 1}`;
}

function draw() {
  const first = labelOf(episode), length = dataset.lengths[episode];
  $("timeline").max = length - 1;
  $("episode-title").textContent = `Episode ${episode}`;
  $("task").textContent = dataset.tasks[episode];
  $("label").textContent = first === NONE ? "no label yet" : first === null ? "a failure"
    : `a success from frame ${first} on (${length - first} frames)`;
  $("play").textContent = playing ? "❚❚ pause" : "▶ play";
  $("last").textContent = $("last-frames").value;
  $("undo").disabled = !past.length;
  const canvas = $("curve"), context = canvas.getContext("2d");
  canvas.width = canvas.clientWidth;
  if (typeof first === "number") {
    context.fillStyle = "#1a7f37";
    context.fillRect(canvas.width * first / length, 2, canvas.width, 10);
  }
  [...$("episodes").children].forEach((button, index) => {
    const label = labelOf(index);
    button.textContent = `${index} ${label === NONE ? "·" : label === null ? "✗" : "✓"}`;
    button.setAttribute("aria-pressed", index === episode);
  });
  const successes = [...labels.values()].filter((label) => label !== null).length;
  $("progress").textContent = `${labels.size} of ${dataset.lengths.length} have a label: `
    + `${successes} successes, ${labels.size - successes} failures`;
  $("finish").disabled = labels.size < dataset.lengths.length;
}

async function play() {
  for (;;) {
    if (!playing) { await sleep(20); continue; }
    const due = performance.now() + 1000 / dataset.fps;
    look(frame + 1);
    await Promise.all([...$("frames").querySelectorAll("img")].map((image) => image.decode().catch(() => {})));
    if (frame === dataset.lengths[episode] - 1) { playing = false; draw(); }
    await sleep(Math.max(0, due - performance.now()));
  }
}

function toggle() {
  if (!playing && frame === dataset.lengths[episode] - 1) look(0);
  playing = !playing;
  draw();
}

const lastFrames = () => Math.max(0, dataset.lengths[episode] - Math.max(1, Number($("last-frames").value)));
const acts = {
  KeyS: () => mark(lastFrames()), KeyM: () => mark(frame), KeyF: () => mark(null), KeyU: undo, Space: toggle,
  ArrowLeft: () => look(frame - 1), ArrowRight: () => look(frame + 1),
  ArrowUp: () => open(episode - 1), ArrowDown: () => open(episode + 1),
};

function listen() {
  const on = (id, act) => { $(id).onclick = () => Promise.resolve(act()).catch(say); };
  on("play", toggle);
  on("back", acts.ArrowLeft);
  on("next", acts.ArrowRight);
  on("success", acts.KeyS);
  on("from-here", acts.KeyM);
  on("failure", acts.KeyF);
  on("undo", undo);
  addEventListener("click", (event) => { if (event.detail) event.target.closest?.("button")?.blur(); });
  on("finish", async () => {
    await sending;
    await post("finish", {});
    say("The labels are complete; the command writes the dataset. This page can be closed.");
  });
  $("timeline").oninput = () => look(Number($("timeline").value));
  $("last-frames").oninput = draw;
  addEventListener("resize", draw);
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.type === "number") return;
    const act = acts[event.code];
    if (!act || (event.code === "Space" && event.target.type === "submit")) return;
    event.preventDefault();
    if (event.repeat && !event.code.startsWith("Arrow")) return; // a key held down labels once
    act();
  });
}

async function main() {
  const response = await fetch(`dataset?${query({})}`);
  if (!response.ok) throw new Error(await response.text());
  dataset = await response.json();
  labels = new Map(Object.entries(dataset.labels).map(([index, first]) => [Number(index), first]));
  $("last-frames").value = dataset.last;
  for (const camera of dataset.cameras) {
    const figure = document.createElement("figure"), caption = document.createElement("figcaption");
    caption.textContent = camera;
    figure.append(Object.assign(document.createElement("img"), { alt: "" }), caption);
    $("frames").append(figure);
  }
  dataset.lengths.forEach((_, index) => {
    const button = document.createElement("button");
    button.onclick = () => open(index);
    $("episodes").append(button);
  });
  listen();
  open(dataset.lengths.findIndex((_, index) => !labels.has(index)) < 0 ? 0
    : dataset.lengths.findIndex((_, index) => !labels.has(index)));
  say("ready");
  play();
}

main().catch(say);
