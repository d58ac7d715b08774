"""How long the page of lerobot-wmrl-play waits for the next frame, from a key to a picture to show.

    python benchmarks/play.py --world_model=outputs/demo/improve/world_model \\
        --dataset.root=outputs/demo/improve/merged --maniskill --exported=outputs/page

The steps of one visitor, over the page's socket on this machine, as fast as they come: from the message until
the picture is decoded, without the browser itself. Beside it, in turns: a step of the environment alone, the
floor; with `--maniskill` a step of ManiSkill with the same cameras; with `--exported` one of a page that was
written by `lerobot-wmrl-play --export`, in Chromium without a window. Writes docs/results/play_speed.json.
"""

import argparse
import asyncio
import base64
import functools
import json
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import aiohttp
import cv2
import numpy as np
import torch
from aiohttp.test_utils import TestServer
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.precision import keep_freed_memory
from lerobot_wmrl.data.dataset import ChosenEpisodes
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import DrivenEnv
from lerobot_wmrl.play.saving import SavedEpisodes
from lerobot_wmrl.play.server import PlayServer
from lerobot_wmrl.play.world import World, load_world

RESULTS: Final = Path(__file__).parents[1] / "docs" / "results" / "play_speed.json"
BLOCK: Final = 50
"""Steps of one kind before it is another one's turn."""

BROWSER_STEPS: Final = """
    const [count, done] = arguments;
    (async () => {
      const { ask } = await import("/static/local.js");
      const { begun } = await ask({ do: "begin", episode: 0, frame: 0 });
      const action = begun.action.map(() => 0), found = [];
      for (let step = 0; step < count; step += 1) {
        const began = performance.now();
        const { view } = await ask({ do: "step", driver: "you", action });
        await Promise.all(view.images.map((src) => Object.assign(new Image(), { src }).decode()));
        found.push(performance.now() - began);
      }
      return found;
    })().then(done, (error) => done(String(error)));
"""


def milliseconds(step: Callable[[], object], count: int) -> list[float]:
    """Return the duration of each of `count` steps."""
    found = []
    for _ in range(count):
        began = time.perf_counter()
        step()
        found.append(1000 * (time.perf_counter() - began))
    return found


def summary(durations: list[float]) -> dict[str, float]:
    """Return quantiles in milliseconds, and frames a second."""
    p50, p99 = np.quantile(durations, [0.5, 0.99])
    return {
        "p50_ms": round(float(p50), 1),
        "p99_ms": round(float(p99), 1),
        "frames_per_s": round(1000 / float(np.mean(durations)), 1),
    }


async def page_steps(socket: aiohttp.ClientWebSocketResponse, actions: int, count: int) -> list[float]:
    """Return the duration of each step of a page that then begins again."""
    message = {"do": "step", "driver": "you", "action": [0.0] * actions}
    found = []
    for _ in range(count):
        began = time.perf_counter()
        await socket.send_json(message)
        view = (await socket.receive_json())["view"]
        for image in view["images"]:
            coded = np.frombuffer(base64.b64decode(image.partition(",")[2]), np.uint8)
            assert cv2.imdecode(coded, cv2.IMREAD_COLOR) is not None
        found.append(1000 * (time.perf_counter() - began))
    await socket.send_json({"do": "rewind", "frame": 0})
    await socket.receive_json()
    return found


@contextmanager
def browser(page: Path) -> Iterator[Callable[[int], list[float]]]:
    """Open an exported page in Chromium. Give what returns the duration of each of some of its steps."""
    handler = functools.partial(QuietHandler, directory=str(page))
    from selenium import webdriver
    from selenium.webdriver.common.by import By
    from selenium.webdriver.support.wait import WebDriverWait

    options = webdriver.ChromeOptions()
    for flag in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage"):
        options.add_argument(flag)
    driver = webdriver.Chrome(options, webdriver.ChromeService(shutil.which("chromedriver")))
    driver.set_script_timeout(600)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            driver.get(f"http://127.0.0.1:{server.server_port}/")
            wait = WebDriverWait(driver, 60)
            wait.until(lambda _: driver.find_element(By.ID, "status").text == "ready")
            yield functools.partial(steps_in, driver)
        finally:
            driver.quit()
            server.shutdown()


def steps_in(driver: Any, count: int) -> list[float]:
    """Return the duration of each of `count` steps of an exported page."""
    found = driver.execute_async_script(BROWSER_STEPS, count)
    if isinstance(found, str):
        raise RuntimeError(found)
    return [float(each) for each in found]


class QuietHandler(SimpleHTTPRequestHandler):
    """Serves files and says nothing."""

    def log_message(self, format: str, *given: object) -> None: ...


async def measure(world: World, maniskill: bool, exported: Path | None, steps: int) -> dict[str, Any]:
    """Measure everything in turns."""
    count = len(world.model.embodiment.action_names)
    alone = world.begin({"episode": 0, "frame": 0}, None)
    action = torch.zeros(1, count)
    works = {"environment": lambda: alone.env.step(action)}
    if maniskill:
        settings = WmrlManiSkillEnv(
            task="push",
            cameras=list(world.tokenizer_config.cameras),
            image_size=world.tokenizer_config.image_size,
        )
        simulator = settings.create_tensor_env(1, "cpu")
        simulator.reset(seed=[0])
        works["maniskill"] = lambda: simulator.step(action)
    found: dict[str, list[float]] = {"page": [], **{name: [] for name in works}}
    with TemporaryDirectory() as folder, ExitStack() as stack:
        local = None if exported is None else stack.enter_context(browser(exported))
        saved = SavedEpisodes(Path(folder) / "driven", world.model.embodiment, world.criterion.frames)
        server = TestServer(PlayServer(world, saved, "127.0.0.1").application())
        await server.start_server()
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(server.make_url("/drive?visit=benchmark")) as socket,
        ):
            await socket.send_json({"do": "begin", "episode": 0, "frame": 0})
            await socket.receive_json()
            await page_steps(socket, count, BLOCK)
            for work in works.values():
                milliseconds(work, BLOCK)
            if local is not None:
                local(BLOCK)
                found["exported"] = []
            for _ in range(steps // BLOCK):
                found["page"] += await page_steps(socket, count, BLOCK)
                for name, work in works.items():
                    found[name] += milliseconds(work, BLOCK)
                if local is not None:
                    found["exported"] += local(BLOCK)
        await server.close()
    return {name: summary(durations) for name, durations in found.items()}


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--world_model", required=True, help="an action world model")
    parser.add_argument(
        "--dataset.root", dest="root", required=True, help="a dataset that it has learnt from"
    )
    parser.add_argument("--steps", type=int, default=500, help="steps of each kind")
    parser.add_argument("--maniskill", action="store_true", help="measure ManiSkill too")
    parser.add_argument("--exported", type=Path, help="an exported page")
    parser.add_argument("--output", type=Path, default=RESULTS, help="JSON file")
    return parser


def main() -> None:
    """Measure everything, print it, write it."""
    keep_freed_memory()
    register_third_party_plugins()
    given = make_parser().parse_args()
    env = DrivenEnv(
        world_model_path=given.world_model,
        episode_length=10_000,
        done_frames=10_000,
    )
    world = load_world(env, ChosenEpisodes(given.root), None, None)
    figures = {
        "threads": torch.get_num_threads(),
        "image_size": world.tokenizer_config.image_size,
        "cameras": len(world.tokenizer_config.cameras),
        **asyncio.run(measure(world, given.maniskill, given.exported, given.steps)),
    }
    print(json.dumps(figures, indent=2))
    write_json(given.output, figures)


if __name__ == "__main__":
    main()
