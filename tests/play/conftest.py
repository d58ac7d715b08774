"""The page's server over small trained models, in a thread with an event loop of its own."""

import asyncio
import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from aiohttp.test_utils import TestServer
from lerobot.configs import PreTrainedConfig
from selenium import webdriver
from selenium.webdriver.remote.webdriver import WebDriver

from lerobot_wmrl.common.policies import read_policy_config
from lerobot_wmrl.data.dataset import ChosenEpisodes
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import DrivenEnv
from lerobot_wmrl.play.saving import SavedEpisodes
from lerobot_wmrl.play.server import PlayServer
from lerobot_wmrl.play.world import World, load_world
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from tests.conftest import give_up_priority
from tests.rl.checkpoints import save_untrained_policy


@pytest.fixture(scope="session")
def play_policy(tmp_path_factory) -> PreTrainedConfig:
    """A cnn with random weights that fits the small dataset."""
    folder = tmp_path_factory.mktemp("policy")
    return read_policy_config(str(save_untrained_policy(folder, actions=7)), ["--device=cpu"])


@pytest.fixture(scope="session")
def make_world(small_dataset, trained_models, play_policy) -> Callable[..., World]:
    """Loads the small models, with a dataset, a policy and ManiSkill as a real environment."""

    def make(real: bool = False, text: bool = False, end: bool = False, **settings: Any) -> World:
        if text:
            settings["reward"] = GeneralConfig()
        env = DrivenEnv(
            world_model_path=str(trained_models["action_world_model"]),
            text_world_model_path=str(trained_models["text_world_model"]) if text else "",
            **{"episode_length": 300, "device": "cpu", **settings},
        )
        simulator = WmrlManiSkillEnv(task="push") if real else None
        return load_world(env, ChosenEpisodes(str(small_dataset.root)), play_policy, simulator, end)

    return make


@pytest.fixture(scope="session")
def world(make_world) -> World:
    """The small models, a dataset and a policy."""
    return make_world()


@pytest.fixture
def saved(world, tmp_path) -> SavedEpisodes:
    """A place for episodes."""
    return SavedEpisodes(tmp_path / "driven", world.model.embodiment, world.criterion.frames)


class Served:
    """A server in a thread: its address, and a way to run coroutines beside it."""

    def __init__(self, world: World, saved: SavedEpisodes, host: str) -> None:
        self.make, self.loop = lambda: PlayServer(world, saved, host), asyncio.new_event_loop()
        threading.Thread(target=self.loop.run_forever, daemon=True).start()
        self.start()

    def start(self, port: int | None = None) -> None:
        """Begin to serve, at a free port by default."""
        self.server = self.make()
        self.http = TestServer(self.server.application(), port=port)
        self.run(self.http.start_server())
        self.address = str(self.http.make_url("/"))

    def stop(self) -> None:
        """Stop serving; drives are lost."""
        self.run(self.http.close())

    def run(self, coroutine: Any) -> Any:
        """Run a coroutine in the server's loop."""
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop).result(120)


@pytest.fixture
def serve() -> Iterator[Callable[..., Served]]:
    """Serves a world until the test ends."""
    served: list[Served] = []

    def begin(world: World, saved: SavedEpisodes, host: str = "127.0.0.1") -> Served:
        served.append(Served(world, saved, host))
        return served[-1]

    yield begin
    for each in served:
        each.stop()


@pytest.fixture
def folder(saved) -> Path:
    """Where driven episodes are saved."""
    return saved.folder


@pytest.fixture(scope="session")
def browser() -> Iterator[WebDriver]:
    """Chromium, without a window on the screen."""
    give_up_priority()
    options = webdriver.ChromeOptions()
    for flag in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1300,1000"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options, webdriver.ChromeService(shutil.which("chromedriver")))
    yield driver
    driver.quit()


@pytest.fixture
def chromium(browser) -> Iterator[WebDriver]:
    """The browser, whose windows are closed after the test."""
    first = browser.current_window_handle
    yield browser
    for window in browser.window_handles:
        if window != first:
            browser.switch_to.window(window)
            browser.close()
    browser.switch_to.window(first)
