"""The page that needs no server: its graphs by ONNX Runtime here, and the page itself in Chromium."""

import base64
import functools
import http.server
import io
import json
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.wait import WebDriverWait

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.dataset import ChosenEpisodes, open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.frames import Frames
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.evaluation.replay import Recording
from lerobot_wmrl.play.export import export_page
from lerobot_wmrl.play.graphs import ExportedWorldModel, export_graphs
from lerobot_wmrl.play.world import World, load_world
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.scripts.play import PlayConfig, play
from lerobot_wmrl.world_models.checkpoint import load_model
from tests.play.page import Page
from tests.trained import (
    CLIP_LENGTH,
    PULL,
    PUSH,
    action_config,
    run_training,
    tokenizer_config,
    told_apart,
)

STARTS = 3


@pytest.fixture(scope="module")
def folder(world: World, tmp_path_factory) -> Path:
    """An exported page."""
    found = tmp_path_factory.mktemp("exported") / "page"
    export_page(world, found, STARTS)
    return found


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder by a server that knows nothing but files. Give its address."""
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


@pytest.fixture
def page(folder, chromium) -> Iterator[Page]:
    with served(folder) as address:
        chromium.get_log("browser")
        yield Page(chromium, address)
        assert [entry for entry in chromium.get_log("browser") if entry["source"] == "javascript"] == []


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
    exported.begin(pictures, state, PUSH)
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


def test_graphs_with_a_context_and_a_success_classifier_and_without_a_state(small_dataset, tmp_path):
    """With a state they are those of the page below whose success depends on the instruction."""
    root = Path(small_dataset.root)
    tokenizer = run_training(tokenizer_config(context=True, success=True), root, tmp_path / "tokenizer")
    config = replace(action_config(tokenizer), state_size=0)
    model = load_model(run_training(config, root, tmp_path / "stateless"), "action_world_model")
    export_graphs(model, tmp_path)
    pictures = np.random.default_rng(0).random((1, 1, 3, 32, 32), np.float32)
    assert agreement(model, tmp_path, pictures, np.zeros((1, 0), np.float32), CLIP_LENGTH + 3) > 0.97


def pixels(source: str) -> np.ndarray:
    """Decode an address of data."""
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(source.split(",")[1]))).convert("RGB"))


def test_the_page_imagines_what_the_graphs_imagine(page, folder):
    pictures, state, actions = first_frame(folder, 0)
    page.choose("recorded")
    for frame in range(1, 4):
        page["next"].click()
        page.wait(lambda frame=frame: page.frame == frame)
    exported = ExportedWorldModel(folder, CLIP_LENGTH)
    exported.begin(pictures, state, PUSH)
    for action in actions[:3]:
        found = exported.step(action[None])
    assert np.abs(pixels(page.image) - found["pixels"][0, ..., :3].astype(float)).mean() < 1


def test_after_going_back_across_a_clip_the_same_actions_lead_to_the_same_pictures(page):
    page.hold(Keys.ARROW_RIGHT, CLIP_LENGTH + 5)
    frames = page.frame
    images = ask(page, {"do": "resume"})["views"]
    assert len(images) == frames + 1
    actions = [each["action"] for each in images[1:]]
    ask(page, {"do": "rewind", "frame": 2})
    for action, expected in zip(actions[2:], images[3:], strict=True):
        assert ask(page, {"do": "step", "driver": "you", "action": action})["view"] == expected


def ask(page: Page, message: dict[str, Any]) -> Any:
    """Ask the world model in the page. Return its answer, or what is wrong."""
    return page.driver.execute_async_script(
        """
        const [message, done] = arguments;
        import("/static/local.js").then(({ ask }) => ask(message)).then(done, (error) => done(error.message));
        """,
        message,
    )


def test_a_page_reads_the_instruction_that_it_is_given(make_synthetic_dataset, tmp_path, chromium):
    """As the world model does, which knows two; other words and none too."""
    root = make_synthetic_dataset(tmp_path / "data", length=12, instructions=(PUSH, PULL)).root
    config = WorldModelEnv(
        world_model_path=str(told_apart(Path(root), tmp_path)), reward=GeneralConfig(alpha=1), device="cpu"
    )
    world = load_world(config, ChosenEpisodes(root=str(root)), None, None)
    folder = tmp_path / "page"
    export_page(world, folder, STARTS)
    pictures, state, actions = first_frame(folder, 0)
    exported, chances = ExportedWorldModel(folder, CLIP_LENGTH), []
    model = world.models.model
    frames = Recording.read(read_episodes(open_dataset(root)), model).starts(model, np.array([0]))
    with served(folder) as address:
        page = Page(chromium, address)
        for given in ({}, {"instruction": PULL}, {"instruction": "zieh das Stück"}):
            ask(page, {"do": "begin", "episode": 0, "frame": 0, **given})
            shown = ask(page, {"do": "step", "driver": "recorded"})["view"]["measured"]["done_probability"]
            exported.begin(pictures, state, given.get("instruction", PUSH))
            expected = exported.step(actions[:1])["done_probability"]
            assert shown == pytest.approx(float(expected[0]), abs=1e-3)
            chances.append(shown)
            asked = replace(
                frames, instruction_weights=model.instruction_weights([given.get("instruction", PUSH)], 1)
            )
            imagined = model.step(model.start(asked), torch.from_numpy(actions[:1])).done_logit.sigmoid()
            assert shown == pytest.approx(float(imagined), abs=0.02)
        for text, wrong in ((" ", "is empty"), ("x" * 600, "has 600 bytes; at most 511")):
            assert f"instruction: {wrong}" in ask(
                page, {"do": "begin", "episode": 0, "frame": 0, "instruction": text}
            )
    assert len({round(chance, 3) for chance in chances}) == 3


def test_an_error_midway_leaves_the_drive_as_it_was(page, folder):
    actions = first_frame(folder, 0)[2].tolist()
    views = [ask(page, {"do": "step", "driver": "you", "action": each})["view"] for each in actions[:6]]
    broken = page.driver.execute_async_script(
        """
        const done = arguments[0];
        (async () => {
          const { ask } = await import("/static/local.js");
          const fetch0 = window.fetch;
          window.fetch = async () => { throw new Error("out of reach"); };
          const message = await ask({ do: "begin", episode: 1, frame: 0 }).catch((error) => error.message);
          window.fetch = fetch0;
          return message;
        })().then(done);
        """
    )
    assert broken == "out of reach"
    assert [each["images"] for each in ask(page, {"do": "resume"})["views"][1:]] == [
        each["images"] for each in views
    ]
    assert ask(page, {"do": "step", "driver": "you", "action": actions[6]})["view"]["frame"] == 7


@pytest.mark.parametrize(
    ("message", "said"),
    [
        ({"do": "step", "driver": "you", "action": [0.0, 0.0]}, "action: must be 7 finite numbers"),
        ({"do": "step", "driver": "you", "action": [None, "a", 0, 0, 0, 0, 0]}, "must be 7 finite numbers"),
        (
            {"do": "begin", "episode": "length", "frame": 0},
            "this page has the first frames (frame 0) of",
        ),
        ({"do": "begin", "episode": 3, "frame": 0}, "of episodes 0 to 2"),
        ({"do": "begin", "episode": 0, "frame": 1}, "of episodes 0 to 2"),
        ({"do": "begin", "picture": "constructor"}, "is none that was uploaded; upload it again"),
    ],
)
def test_what_cannot_be_is_said_and_changes_nothing(page, message, said):
    before = ask(page, {"do": "resume"})
    assert said in ask(page, message)
    assert ask(page, {"do": "resume"}) == before


def test_a_recorded_episode_ends_and_actions_in_range_are_not_clipped(page, folder):
    actions = first_frame(folder, 1)[2]
    ask(page, {"do": "begin", "episode": 1, "frame": 0})
    views = [ask(page, {"do": "step", "driver": "recorded"})["view"] for _ in actions]
    assert {view["measured"]["clipped"] for view in views} == {0}
    assert "the recorded episode is over" in ask(page, {"do": "step", "driver": "recorded"})


def test_a_drive_ends_at_success_and_at_its_length(make_world, folder, tmp_path, chromium, monkeypatch):
    """The graphs are those of the same world model in the other page."""
    world = make_world(end=True, done_threshold=1e-9, done_frames=2, episode_length=300)
    monkeypatch.setattr("lerobot_wmrl.play.export.export_graphs", functools.partial(copy_graphs, folder))
    export_page(world, tmp_path / "page", 1)
    with served(tmp_path / "page") as address:
        page = Page(chromium, address)
        first, second = (ask(page, {"do": "step", "driver": "recorded"})["view"] for _ in range(2))
    assert (first["ended"], second["ended"]) == ("", "success")
    assert (first["measured"]["reward"], second["measured"]["reward"]) == (0, 1)


def copy_graphs(folder: Path, model: Any, new: Path) -> None:
    for path in folder.glob("*.onnx*"):
        shutil.copy(path, new)


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


def test_a_picture_is_a_place_to_begin_that_has_no_link(page, tmp_path):
    page.driver.find_element(By.CSS_SELECTOR, "#places button[value=picture]").click()
    begin = page.driver.find_element(By.CSS_SELECTOR, "#place-picture button")
    page["picture-state"].send_keys("[a]")
    begin.click()
    page.wait(lambda: "must be 8 finite numbers" in page["status"].text)
    page["picture-state"].clear()
    page["picture-state"].send_keys(", ".join("0" * 8))
    begin.click()
    page.wait(lambda: "give one for each camera: third_view" in page["status"].text)
    file = page.driver.find_element(By.NAME, "third_view")
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"no picture")
    file.send_keys(str(broken))
    begin.click()
    page.wait(lambda: "broken.png cannot be read" in page["status"].text)
    stripes = np.tile(np.array([20, 200], np.uint8).repeat(3), (300, 200, 1))[..., :3]
    stripes[:, 100:] = (0, 128, 128)
    picture = tmp_path / "picture.png"
    Image.fromarray(np.ascontiguousarray(stripes)).save(picture)
    file.send_keys(str(picture))
    begin.click()
    page.wait(lambda: page["status"].text == "ready" and page.frame == 0)
    shown = np.asarray(Image.open(picture).resize((32, 32), Image.Resampling.BILINEAR), float)
    assert np.abs(pixels(page.image) - shown).mean() < 6
    page["next"].click()
    page.wait(lambda: page.frame == 1)
    page["link"].click()
    page.wait(lambda: "has no link" in page["status"].text)


def test_a_page_whose_world_model_cannot_be_loaded_says_so(folder, tmp_path, chromium):
    shutil.copytree(folder, tmp_path / "page")
    (tmp_path / "page" / "static" / "ort.wasm.min.js").unlink()
    with served(tmp_path / "page") as address:
        chromium.switch_to.new_window("window")
        chromium.get(address)
        WebDriverWait(chromium, 60).until(
            lambda _: "the world model cannot be loaded" in chromium.find_element(By.ID, "status").text
        )


def test_what_has_no_meaning_without_a_server_is_not_shown(page):
    for hidden in ("save", "save-success", "save-failure", "episode-frame", "difference-field"):
        assert not page[hidden].is_displayed()
    assert [each.text for each in page.driver.find_elements(By.CSS_SELECTOR, "#drivers button")] == [
        "you",
        "recorded",
    ]
    page.press("s")
    assert page["status"].text == "ready"


def test_autoregressive_dynamics_are_refused(small_dataset, trained_models, tmp_path):
    config = action_config(trained_models["frame_tokenizer"], dynamics="autoregressive")
    trained = run_training(config, Path(small_dataset.root), tmp_path / "autoregressive")
    with pytest.raises(FieldError, match=r"^world_model\.path=.*has autoregressive dynamics"):
        export_graphs(load_model(trained, "action_world_model"), tmp_path)


@pytest.fixture
def config(small_dataset, trained_models, tmp_path) -> PlayConfig:
    found = PlayConfig(export=tmp_path / "page")
    found.world_model.path = str(trained_models["action_world_model"])
    found.dataset.root = str(small_dataset.root)
    return found


def test_ctrl_c_ends_the_server_and_is_no_error(config, monkeypatch, tmp_path):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("lerobot_wmrl.play.web.serve", interrupted)
    play(replace(config, export=None, output_dir=tmp_path / "driven"))


def test_a_page_without_frames_and_a_full_folder_are_refused(config, tmp_path):
    (tmp_path / "page").mkdir()
    (tmp_path / "page" / "note.txt").touch()
    with pytest.raises(FieldError, match=r"^export=.*: there is something already; choose a new folder"):
        play(config)
    config.export = tmp_path / "new"
    config.text_world_model.path = "text"
    with pytest.raises(FieldError, match=r"^text_world_model\.path=text: is in no exported page; leave it"):
        play(config)
    config.dataset.root, config.real_env = None, WmrlManiSkillEnv()
    with pytest.raises(FieldError, match=r"^dataset\.root=: is missing: an exported page begins in its"):
        play(config)


def test_without_npm_it_says_so_and_leaves_nothing(config, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(FieldError, match=r"^export=onnxruntime-web.*: npm cannot fetch it .*; install npm"):
        play(config)
    assert not (tmp_path / "page").exists()
