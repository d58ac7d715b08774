// The page's world model runs in this browser: three graphs (lerobot_wmrl/play/graphs.py) that hand named tensors
// to each other. A drive is the pictures where it begins and the actions since, as in lerobot_wmrl/play/drive.py.

import * as ort from "./ort.wasm.min.mjs";

const NEXT = "next_"; // before the name of an output that the same graph's next run reads
ort.env.wasm.numThreads = self.crossOriginIsolated ? navigator.hardwareConcurrency : 1;
const graphs = {};
const pictures = {}; // uploaded
let world, drive = null;

export async function describe() {
  world = await (await fetch("world.json")).json();
  await Promise.all(["look", "scene", "step"].map(async (name) => {
    graphs[name] = await ort.InferenceSession.create(`${name}.onnx`, { graphOptimizationLevel: "all" });
  }));
  return world;
}

export function connect(opened) {
  opened();
}

export async function ask(message) {
  const does = { begin, step, rewind, resume };
  return does[message.do](message);
}

export async function upload(form) {
  const state = JSON.parse(form.get("state") ?? "[]");
  if (state.length !== world.state.length || !state.every(Number.isFinite)) {
    throw new Error(`state: must be ${world.state.length} finite numbers: ${world.state.join(", ")}`);
  }
  const images = await Promise.all(world.cameras.map((camera) => createImageBitmap(form.get(camera))))
    .catch(() => { throw new Error(`picture: give one for each camera: ${world.cameras.join(", ")}`); });
  const name = String(Object.keys(pictures).length);
  pictures[name] = { images, state, actions: [], task: form.get("instruction") };
  return { picture: name };
}

// ---- the drive ---------------------------------------------------------------------------------------------

async function begin({ do: _, ...place }) {
  const start = "picture" in place ? pictures[place.picture] : await recorded(place);
  if (!start) throw new Error(`picture ${place.picture} is no picture that was uploaded: upload it again`);
  const squares = start.images.map((image) => drawn(image, world.side, world.side));
  drive = { place, start, squares, task: place.instruction ?? start.task, actions: [], views: [] };
  await look();
  drive.views.push(view(squares, "", {}));
  return resume();
}

async function recorded({ episode, frame }) {
  if (!(episode in world.episodes) || frame !== 0) {
    throw new Error(`episode ${episode}, frame ${frame}: this page has the first frames of ` +
      `${world.episodes.length} episodes`);
  }
  const { state, actions, task } = world.episodes[episode];
  const images = await Promise.all(world.cameras.map(async (camera) =>
    createImageBitmap(await (await fetch(`frames/${episode}_${camera}.png`)).blob())));
  return { images, state, actions, task };
}

function resume() {
  if (!drive) return { begun: null, views: [] };
  const { place, task, start, views } = drive;
  const begun = {
    place, instruction: task, goal: [], recorded: start.actions.length, action: start.actions[0] ?? [],
  };
  return { begun, views: [...views] };
}

async function step({ driver, action }) {
  if (drive.ended) throw new Error(`the episode has ended (${drive.ended}): go back or restart`);
  const given = driver === "recorded" ? drive.start.actions[drive.actions.length] : action;
  if (!given) throw new Error("the recorded episode is over: choose who goes on");
  const measured = await imagine(given);
  drive.actions.push(given);
  const views = [...Array(world.cameras.length).keys()].map((index) => canvasOf(drive.memory.pixels, index));
  drive.views.push(view(views, driver, measured, given));
  return { view: drive.views.at(-1) };
}

async function rewind({ frame }) {
  const actions = drive.actions.slice(0, frame);
  await look();
  for (const action of actions) await imagine(action);
  Object.assign(drive, { actions, views: drive.views.slice(0, frame + 1) });
  return {};
}

// ---- the world model ---------------------------------------------------------------------------------------

// Read the beginning anew; nothing is imagined yet.
async function look() {
  const { start, squares } = drive, area = world.side ** 2, seen = new Float32Array(squares.length * 3 * area);
  squares.forEach((canvas, index) => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, world.side, world.side);
    for (let pixel = 0; pixel < area; pixel += 1) {
      for (let colour = 0; colour < 3; colour += 1) {
        seen[(3 * index + colour) * area + pixel] = data[4 * pixel + colour] / 255;
      }
    }
  });
  drive.memory = {
    pictures: new ort.Tensor("float32", seen, [1, squares.length, 3, world.side, world.side]),
    measured_state: new ort.Tensor("float32", start.state, [1, start.state.length]),
  };
  Object.assign(drive, { ended: "", streak: 0, imagined: 0 });
  await run("look");
}

// Imagine the frame after an action, and return what is measured in it.
async function imagine(action) {
  const taken = action.map((each, index) => Math.min(world.axes[index].high, Math.max(world.axes[index].low, each)));
  const age = drive.imagined % world.window;
  if (age === 0) await run("scene");
  drive.memory.action = new ort.Tensor("float32", taken, [1, taken.length]);
  drive.memory.age = new ort.Tensor("int64", [BigInt(age)], [1]);
  await run("step");
  const [done] = drive.memory.done_probability.data, [entropy] = drive.memory.token_entropy.data;
  drive.imagined += 1;
  drive.streak = done >= world.done_threshold ? drive.streak + 1 : 0;
  const success = drive.streak >= world.done_frames;
  if (success && world.end_at_success) drive.ended = "success";
  else if (drive.imagined >= world.episode_length) drive.ended = "end";
  return {
    reward: Number(success), done_probability: done, token_entropy: entropy,
    clipped: taken.filter((each, index) => each !== action[index]).length / taken.length,
  };
}

// Run a graph on the tensors of the drive, and keep what it returns.
async function run(name) {
  const graph = graphs[name], given = Object.fromEntries(graph.inputNames.map((each) => [each, drive.memory[each]]));
  for (const [each, tensor] of Object.entries(await graph.run(given))) {
    drive.memory[each.startsWith(NEXT) ? each.slice(NEXT.length) : each] = tensor;
  }
}

// ---- pictures ----------------------------------------------------------------------------------------------

function drawn(image, width, height) {
  const canvas = Object.assign(document.createElement("canvas"), { width, height });
  canvas.getContext("2d", { willReadFrequently: true }).drawImage(image, 0, 0, width, height);
  return canvas;
}

// One camera's picture in the bytes (N, S, S, 4) of a frame.
function canvasOf(pixels, index) {
  const size = 4 * world.side ** 2;
  const data = new Uint8ClampedArray(pixels.data.buffer, pixels.data.byteOffset + index * size, size);
  const canvas = Object.assign(document.createElement("canvas"), { width: world.side, height: world.side });
  canvas.getContext("2d", { willReadFrequently: true }).putImageData(new ImageData(data, world.side, world.side), 0, 0);
  return canvas;
}

function view(squares, driver, measured, action = []) {
  const images = squares.map((canvas, index) => drawn(canvas, ...world.sizes[index]).toDataURL());
  return { frame: drive.actions.length, driver, images, action, measured, ended: drive.ended };
}
