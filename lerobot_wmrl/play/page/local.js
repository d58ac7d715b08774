// The page's world model runs in this browser: three graphs (lerobot_wmrl/play/graphs.py) that hand named tensors
// to each other. A drive is the pictures where it begins and the actions since, as in lerobot_wmrl/play/drive.py.

import * as ort from "./ort.wasm.min.js";

const NEXT = "next_"; // before the name of an output that the same graph's next run reads
const MOST_UPLOADS = 16, MOST_TOKENS = 512;
const here = (name) => new URL(`./${name}`, import.meta.url).href;
ort.env.wasm.wasmPaths = { mjs: here("ort-wasm-simd-threaded.js"), wasm: here("ort-wasm-simd-threaded.wasm") };
const graphs = {};
const uploads = new Map(); // name → start
let world, drive = null;

export async function describe() {
  world = await (await fetched("world.json")).json();
  await Promise.all(["start", "scene", "step"].map(async (name) => {
    graphs[name] = await ort.InferenceSession.create(new Uint8Array(await (await fetched(`${name}.onnx`)).arrayBuffer()));
  }));
  return world;
}

export function connect(opened) {
  opened();
}

export async function ask(message) {
  return { begin, step, rewind, resume }[message.do](message);
}

export async function upload(form) {
  const state = numbers(form.get("state") ?? "[]");
  if (state?.length !== world.state.length) {
    throw new Error(`state: must be ${world.state.length} finite numbers: ${world.state.join(", ")}`);
  }
  const squares = await Promise.all(world.cameras.map(async (camera) => {
    const file = form.get(camera);
    if (!file?.size) throw new Error(`picture: give one for each camera: ${world.cameras.join(", ")}`);
    return square(await decoded(file, file.name));
  }));
  const name = Array.from(crypto.getRandomValues(new Uint8Array(8)), (byte) => byte.toString(16)).join("");
  uploads.set(name, { squares, state, actions: [], task: form.get("instruction") });
  if (uploads.size > MOST_UPLOADS) uploads.delete(uploads.keys().next().value);
  return { picture: name };
}

function numbers(text) {
  try {
    const found = JSON.parse(text);
    return Array.isArray(found) && found.every(Number.isFinite) ? found : null;
  } catch { return null; }
}

async function fetched(path) {
  const response = await fetch(path);
  if (!response.ok) throw new Error(`${path} cannot be loaded (${response.status}); reload, or export the page again`);
  return response;
}

// ---- the drive ---------------------------------------------------------------------------------------------

async function begin({ do: _, ...place }) {
  const start = "picture" in place ? uploads.get(place.picture) : await recorded(place);
  if (!start) throw new Error("picture: is none that was uploaded; upload it again");
  const task = place.instruction ?? start.task;
  const begun = { place, start, task, actions: [], episode: await newEpisode(start, task) };
  drive = { ...begun, views: [viewOf(begun, start.squares, "", {})] };
  return resume();
}

async function recorded({ episode, frame }) {
  if (!Number.isInteger(episode) || !world.episodes[episode] || frame !== 0) {
    throw new Error(`episode: this page has the first frames (frame 0) of episodes 0 to ${world.episodes.length - 1}`);
  }
  const { state, actions, task } = world.episodes[episode];
  const squares = await Promise.all(world.cameras.map(async (camera) => {
    const path = `frames/${episode}_${camera}.png`;
    return square(await decoded(await (await fetched(path)).blob(), path));
  }));
  return { squares, state, actions, task };
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
  const { start, actions, episode, views } = driving();
  if (episode.ended) throw new Error(`the episode has ended (${episode.ended}): go back or restart`);
  const given = driver === "recorded" ? start.actions[actions.length] : action;
  if (!given) throw new Error("the recorded episode is over: choose who goes on");
  if (given.length !== world.axes.length || !given.every(Number.isFinite)) {
    throw new Error(`action: must be ${world.axes.length} finite numbers`);
  }
  const measured = await imagine(episode, given);
  actions.push(given);
  views.push(viewOf(drive, world.cameras.map((_, index) => canvasOf(episode.tensors.pixels, index)), driver, measured));
  return { view: views.at(-1) };
}

// Imagine the past anew; the drive stays as it is until that is done.
async function rewind({ frame }) {
  const { start, task, actions, views } = driving(), kept = actions.slice(0, frame);
  const episode = await newEpisode(start, task);
  for (const action of kept) await imagine(episode, action);
  Object.assign(drive, { episode, actions: kept, views: views.slice(0, frame + 1) });
  return {};
}

function driving() {
  if (!drive) throw new Error("nothing has begun: choose where it begins");
  return drive;
}

// ---- the world model ---------------------------------------------------------------------------------------

// An imagined episode before its first action.
async function newEpisode({ squares, state }, task) {
  const area = world.side ** 2, seen = new Float32Array(squares.length * 3 * area);
  squares.forEach((canvas, index) => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, world.side, world.side);
    for (let pixel = 0; pixel < area; pixel += 1) {
      for (let colour = 0; colour < 3; colour += 1) {
        seen[(3 * index + colour) * area + pixel] = data[4 * pixel + colour] / 255;
      }
    }
  });
  const episode = { imagined: 0, streak: 0, ended: "", tensors: {
    pictures: new ort.Tensor("float32", seen, [1, squares.length, 3, world.side, world.side]),
    measured_state: new ort.Tensor("float32", state, [1, state.length]),
  } };
  if (graphs.start.inputNames.includes("instruction_bytes")) episode.tensors.instruction_bytes = bytesOf(task);
  await run("start", episode);
  return episode;
}

// An instruction as ByT5 reads it (instruction_bytes in lerobot_wmrl/play/graphs.py).
function bytesOf(task) {
  if (!task?.trim()) throw new Error("instruction: is empty, and it says what success is");
  const bytes = new TextEncoder().encode(task), ids = new BigInt64Array(MOST_TOKENS);
  if (bytes.length >= MOST_TOKENS) {
    throw new Error(`instruction: has ${bytes.length} bytes; at most ${MOST_TOKENS - 1} are read`);
  }
  bytes.forEach((byte, index) => { ids[index] = BigInt(byte + 3); });
  ids[bytes.length] = 1n;
  return new ort.Tensor("int64", ids, [1, MOST_TOKENS]);
}

// Imagine the frame after an action, and return what is measured in it.
async function imagine(episode, action) {
  const { tensors } = episode, age = episode.imagined % world.window;
  const given = action.map(Math.fround);
  const taken = given.map((each, index) =>
    Math.min(Math.fround(world.axes[index].high), Math.max(Math.fround(world.axes[index].low), each)));
  if (age === 0) await run("scene", episode);
  tensors.action = new ort.Tensor("float32", taken, [1, taken.length]);
  tensors.age = new ort.Tensor("int64", [BigInt(age)], [1]);
  await run("step", episode);
  const [done] = tensors.done_probability.data, [entropy] = tensors.token_entropy.data;
  episode.imagined += 1;
  episode.streak = done >= world.done_threshold ? episode.streak + 1 : 0;
  const success = episode.streak >= world.done_frames;
  if (success) episode.ended = "success";
  else if (episode.imagined >= world.episode_length) episode.ended = "end";
  return {
    reward: Number(success), done_probability: done, token_entropy: entropy,
    clipped: taken.filter((each, index) => each !== given[index]).length / taken.length,
  };
}

// Run a graph on an episode's tensors, and keep what it returns.
async function run(name, { tensors }) {
  const graph = graphs[name];
  const found = await graph.run(Object.fromEntries(graph.inputNames.map((each) => [each, tensors[each]])));
  for (const [each, tensor] of Object.entries(found)) {
    tensors[each.startsWith(NEXT) ? each.slice(NEXT.length) : each] = tensor;
  }
}

// ---- pictures ----------------------------------------------------------------------------------------------

async function decoded(blob, name) {
  try {
    return await createImageBitmap(blob);
  } catch { throw new Error(`picture: ${name} cannot be read; send PNG, JPEG or WEBP`); }
}

// What the tokenizer sees of a picture.
function square(image) {
  const canvas = drawn(image, world.side, world.side);
  image.close();
  return canvas;
}

function drawn(image, width, height) {
  const canvas = Object.assign(document.createElement("canvas"), { width, height });
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.imageSmoothingQuality = "high";
  context.drawImage(image, 0, 0, width, height);
  return canvas;
}

// One camera's picture in the bytes (N, S, S, 4) of a frame.
function canvasOf(pixels, index) {
  const size = 4 * world.side ** 2;
  const data = new Uint8ClampedArray(pixels.data.buffer, pixels.data.byteOffset + index * size, size);
  const canvas = Object.assign(document.createElement("canvas"), { width: world.side, height: world.side });
  canvas.getContext("2d").putImageData(new ImageData(data, world.side, world.side), 0, 0);
  return canvas;
}

function viewOf({ actions, episode }, squares, driver, measured) {
  const images = squares.map((canvas, index) => drawn(canvas, ...world.sizes[index]).toDataURL());
  return { frame: actions.length, driver, images, action: actions.at(-1) ?? [], measured, ended: episode.ended };
}
