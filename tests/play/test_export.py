"""The page that needs no server: its graphs by ONNX Runtime here, and the page itself in Chromium."""

import base64
import functools
import http.server
import io
import json
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.frames import Frames
from lerobot_wmrl.play.export import export_page
from lerobot_wmrl.play.graphs import ExportedWorldModel, export_graphs
from lerobot_wmrl.play.world import World
from lerobot_wmrl.scripts.play import PlayConfig, play
from lerobot_wmrl.world_models.checkpoint import load_model
from tests.play.page import Page
from tests.trained import CLIP_LENGTH, action_config, run_training, tokenizer_config

STARTS = 3


@pytest.fixture(scope="module")
def folder(world: World, tmp_path_factory) -> Path:
    """An exported page."""
    found = tmp_path_factory.mktemp("exported") / "page"
    export_page(world, found, STARTS)
    return found


@pytest.fixture
def page(folder, chromium) -> Iterator[Page]:
    """The page from a server that knows nothing but files."""
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        chromium.get_log("browser")
        yield Page(chromium, f"http://127.0.0.1:{server.server_port}/")
        assert [entry for entry in chromium.get_log("browser") if entry["source"] == "javascript"] == []
        server.shutdown()


def first_frame(folder: Path, episode: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what a page begins with: pictures (1, N, 3, S, S), state (1, P), and the recorded actions."""
    world = json.loads((folder / "world.json").read_text())
    frames = [
        np.asarray(Image.open(folder / "frames" / f"{episode}_{name}.png")) for name in world["cameras"]
    ]
    pictures = np.stack(frames).transpose(0, 3, 1, 2)[None].astype(np.float32) / 255
    found = world["episodes"][episode]
    return pictures, np.array([found["state"]], np.float32), np.array(found["actions"], np.float32)


def agreement(model: Any, folder: Path, pictures: np.ndarray, state: np.ndarray, steps: int) -> float:
    """Return the share of tokens that the graphs and the model agree on, over random actions."""
    exported = ExportedWorldModel(folder, model.config.clip_length)
    exported.begin(pictures, state)
    images = torch.from_numpy(pictures)
    context = model.tokenizer.context(images)
    tokens = model.tokenizer.encode(images, context)
    actions = 0.3 * torch.randn(1, steps, 7, generator=torch.Generator().manual_seed(0))
    imagined = model.imagine(Frames(tokens, torch.from_numpy(state), context), actions)
    same = []
    for action, expected in zip(actions.unbind(1), imagined, strict=True):
        found = exported.step(action.numpy())
        codes = model.dynamics.network.codebook.codes(expected.tokens)
        same.append((found["codes"][0, 0] == codes[0].numpy()).mean())
        assert found["done_probability"] == pytest.approx(expected.done_logit.sigmoid().numpy(), abs=0.02)
        assert found["token_entropy"] == pytest.approx(expected.entropy.numpy(), abs=0.02)
    return float(np.mean(same))


def test_the_graphs_imagine_what_the_world_model_imagines_beyond_a_clip_too(world, folder):
    pictures, state, _ = first_frame(folder, 1)
    assert agreement(world.models.model, folder, pictures, state, 2 * CLIP_LENGTH + 3) > 0.97


def test_graphs_with_a_context_and_a_success_classifier(small_dataset, tmp_path):
    root = Path(small_dataset.root)
    tokenizer = run_training(tokenizer_config(context=True, success=True), root, tmp_path / "tokenizer")
    trained = run_training(action_config(tokenizer), root, tmp_path / "action_world_model")
    model = load_model(trained, "action_world_model")
    export_graphs(model, tmp_path)
    pictures, state = np.random.default_rng(0).random((1, 1, 3, 32, 32), np.float32), np.zeros((1, 8))
    assert agreement(model, tmp_path, pictures, state.astype(np.float32), CLIP_LENGTH + 3) > 0.97


def test_a_world_model_without_a_state(small_dataset, trained_models, tmp_path):
    root = Path(small_dataset.root)
    config = replace(action_config(trained_models["frame_tokenizer"]), state_size=0)
    model = load_model(run_training(config, root, tmp_path / "stateless"), "action_world_model")
    export_graphs(model, tmp_path)
    pictures = np.random.default_rng(0).random((1, 1, 3, 32, 32), np.float32)
    assert agreement(model, tmp_path, pictures, np.zeros((1, 0), np.float32), 3) > 0.97


def pixels(source: str) -> np.ndarray:
    """Decode an address of data."""
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(source.split(",")[1]))).convert("RGB"))


def test_the_page_imagines_without_a_server(page, folder, world):
    pictures, state, actions = first_frame(folder, 0)
    page.choose("recorded")
    for frame in range(1, 4):
        page["next"].click()
        page.wait(lambda frame=frame: page.frame == frame)
    exported = ExportedWorldModel(folder, CLIP_LENGTH)
    exported.begin(pictures, state)
    for action in actions[:3]:
        found = exported.step(action[None])
    assert np.abs(pixels(page.image) - found["pixels"][0, ..., :3].astype(float)).mean() < 1

    page.choose("you")
    page.hold(Keys.ARROW_RIGHT, CLIP_LENGTH + 5)
    there = page.frame
    before = page.image
    page.press("k")  # something else
    page.pause()
    page.driver.execute_script(
        "const t = arguments[0]; t.value = 2; t.dispatchEvent(new Event('input'))", page["timeline"]
    )
    assert page.frame == 2
    second = page.image
    page["next"].click()  # branches off
    page.wait(lambda: page.frame == 3)
    page["back"].click()
    assert page.image == second
    assert there > CLIP_LENGTH
    assert before


def test_the_page_begins_elsewhere_and_its_links_replay(page, tmp_path):
    episode = page["episode"]
    episode.clear()
    episode.send_keys("2")
    page.driver.find_element(By.CSS_SELECTOR, "#place-episode button").click()
    page.wait(lambda: page["status"].text == "ready")
    page.hold(Keys.ARROW_UP, 4)
    driven, image = page.frame, page.image
    page["link"].click()
    page.wait(lambda: "%22episode%22%3A2" in page.driver.current_url)
    page.driver.refresh()
    page.wait(lambda: page["status"].text == "ready" and page.frame == driven)
    assert page.image == image

    page.driver.find_element(By.CSS_SELECTOR, "#places button[value=picture]").click()
    picture = tmp_path / "picture.png"
    Image.new("RGB", (50, 40), "teal").save(picture)
    page.driver.find_element(By.NAME, "third_view").send_keys(str(picture))
    begin = page.driver.find_element(By.CSS_SELECTOR, "#place-picture button")
    begin.click()
    page.wait(lambda: "must be 8 finite numbers" in page["status"].text)
    page["picture-state"].send_keys(", ".join("0" * 8))
    begin.click()
    page.wait(lambda: page["status"].text == "ready" and page.frame == 0)
    assert np.abs(pixels(page.image) - (0, 128, 128)).max() <= 2
    page["next"].click()
    page.wait(lambda: page.frame == 1)


def test_what_has_no_meaning_without_a_server_is_not_shown(page):
    for hidden in ("save", "save-success", "save-failure", "episode-frame", "difference-field"):
        assert not page[hidden].is_displayed()
    assert [each.text for each in page.driver.find_elements(By.CSS_SELECTOR, "#drivers button")] == [
        "you", "recorded",
    ]  # fmt: skip
    page.press("s")
    assert page["status"].text == "ready"


def test_autoregressive_dynamics_are_refused(small_dataset, trained_models, tmp_path):
    config = action_config(trained_models["frame_tokenizer"], dynamics="autoregressive")
    trained = run_training(config, Path(small_dataset.root), tmp_path / "autoregressive")
    with pytest.raises(FieldError, match=r"^world_model\.path=.*has autoregressive dynamics"):
        export_graphs(load_model(trained, "action_world_model"), tmp_path)


@pytest.fixture
def config(small_dataset, trained_models, tmp_path) -> PlayConfig:
    found = PlayConfig(export=tmp_path / "page", device="cpu")
    found.world_model.path = str(trained_models["action_world_model"])
    found.dataset.root = str(small_dataset.root)
    return found


def test_a_page_without_frames_and_a_full_folder_are_refused(config, tmp_path):
    (tmp_path / "page").mkdir()
    (tmp_path / "page" / "note.txt").touch()
    with pytest.raises(FieldError, match=r"^export=.*: there is something already; choose a new folder"):
        play(config)
    config.dataset.root, config.real_env = None, config
    with pytest.raises(FieldError, match=r"^dataset\.root=: is missing: an exported page begins in its"):
        play(config)


def test_without_npm_it_says_so_and_leaves_nothing(config, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(FieldError, match=r"^export=onnxruntime-web.*: npm cannot fetch it .*; install npm"):
        play(config)
    assert not (tmp_path / "page").exists()
