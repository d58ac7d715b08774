"""Labels by hand, in Chromium and by requests."""

import json
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import cv2
import numpy as np
import pytest
from lerobot.datasets.dataset_tools import remove_feature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.remote.webdriver import WebDriver

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.dataset import DatasetSource, open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.play.label_page import LabelPage
from lerobot_wmrl.play.labels import ByHandRule
from lerobot_wmrl.scripts.label import LabelConfig, label
from tests.relabelled import relabelled

CAMERA = "observation.images.third_view"


@pytest.fixture(scope="module")
def unlabelled(small_dataset, tmp_path_factory) -> LeRobotDataset:
    """Six episodes that do not say where they succeed."""
    root = tmp_path_factory.mktemp("by_hand") / "unlabelled"
    remove_feature(small_dataset, ["next.success", "next.done"], output_dir=root, repo_id="local/unlabelled")
    return open_dataset(root)


@pytest.fixture
def rule(tmp_path) -> ByHandRule:
    return ByHandRule(file=tmp_path / "labels.json", port=0)


def page_of(rule: ByHandRule, dataset: LeRobotDataset) -> LabelPage:
    return LabelPage(rule.file, rule.last, rule.host, dataset)


@pytest.fixture
def labelling(unlabelled, rule, tmp_path, monkeypatch) -> tuple[threading.Thread, str]:
    """The command, in a thread, and the address of its page."""
    said: list[str] = []
    monkeypatch.setattr("builtins.print", lambda *texts, **options: said.append(" ".join(map(str, texts))))
    config = LabelConfig(DatasetSource(str(unlabelled.root)), rule, tmp_path / "labelled")
    command = threading.Thread(target=label, args=(config,), daemon=True)
    command.start()
    wait(lambda: said)
    return command, said[0].split()[1]


@pytest.fixture
def address(labelling) -> Iterator[str]:
    """The page's address; the command ends after the test."""
    command, address = labelling
    yield address
    for episode in range(6):
        post(f"{address}label", {"episode": episode, "first": None})
    post(f"{address}finish", {})
    command.join(60)


def wait(condition: Callable[[], Any]) -> None:
    last = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < last
        time.sleep(0.02)


def post(url: str, content: Any, **headers: str) -> tuple[int, str]:
    """Return status and text of the answer."""
    body = content if isinstance(content, bytes) else json.dumps(content).encode()
    request = Request(url, body, {"Content-Type": "application/json", **headers})
    try:
        with urlopen(request, timeout=60) as response:
            return response.status, response.read().decode()
    except HTTPError as error:
        return error.code, error.read().decode()


def get(url: str) -> tuple[int, bytes]:
    try:
        with urlopen(url, timeout=60) as response:
            return response.status, response.read()
    except HTTPError as error:
        return error.code, error.read()


def test_somebody_labels_by_keys_and_the_dataset_is_written(chromium: WebDriver, labelling, tmp_path):
    command, address = labelling
    chromium.switch_to.new_window("window")
    chromium.get(address)

    def text(name: str) -> str:
        return str(chromium.find_element(By.ID, name).text)

    wait(lambda: text("status") == "ready")

    def press(key: str, *, then: str) -> None:
        ActionChains(chromium).send_keys(key).perform()
        wait(
            lambda: then in f"{text('episode-title')}; {text('label')}; {text('progress')}; {text('counter')}"
        )

    press("s", then="Episode 1;")
    press("f", then="Episode 2;")
    press("u", then="Episode 1; no label yet; 1 of 6")  # and back again
    press("f", then="Episode 2;")
    press(Keys.ARROW_RIGHT, then="frame 1 of")
    press(Keys.ARROW_RIGHT, then="frame 2 of")
    press("m", then="Episode 3;")
    press(Keys.ARROW_UP, then="a success from frame 2 on")
    press(Keys.ARROW_DOWN, then="Episode 3;")
    finish = chromium.find_element(By.ID, "finish")
    assert not finish.is_enabled()
    for episode in (4, 5):
        press("f", then=f"Episode {episode};")
    press("s", then="6 of 6 have a label: 3 successes, 3 failures")
    image = chromium.find_element(By.CSS_SELECTOR, "#frames img")
    wait(lambda: chromium.execute_script("return arguments[0].naturalWidth", image) == 32)
    finish.click()
    command.join(60)
    assert not command.is_alive()
    table = read_episodes(open_dataset(tmp_path / "labelled"))
    ends = [table.done[a : a + n] for a, n in zip(table.start, table.length, strict=True)]
    assert [int(each.sum()) for each in ends] == [4, 0, int(table.length[2]) - 1, 0, 0, 4], (
        "the action before a solved frame succeeds"
    )
    assert all(each[-1] for each in (ends[0], ends[2], ends[5]))


def test_labels_are_kept_while_they_are_made(address, rule, unlabelled):
    assert post(f"{address}label", {"episode": 3, "first": 5})[0] == 200
    assert post(f"{address}label", {"episode": 1, "first": None})[0] == 200
    assert post(f"{address}label", {"episode": 1, "first": "none"})[0] == 200
    assert page_of(rule, unlabelled).labels == {3: 5}
    assert json.loads(get(f"{address}dataset")[1])["labels"] == {"3": 5}


def test_ctrl_c_keeps_the_labels_and_says_so(unlabelled, rule, tmp_path):
    page_of(rule, unlabelled).label(2, 4)
    command = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "lerobot_wmrl.scripts.label",
            f"--dataset.root={unlabelled.root}",
            "--success.type=by_hand",
            f"--success.file={rule.file}",
            "--success.port=0",
            f"--output_dir={tmp_path / 'labelled'}",
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a background job ignores it
    )
    assert command.stdout is not None
    assert next(line for line in command.stdout if line.startswith("open "))
    command.send_signal(signal.SIGINT)
    said = command.communicate(timeout=60)[1]
    assert said.strip().splitlines()[-1] == (
        f"stopped: 1 of 6 episodes have a label, kept in {rule.file}; the same command goes on"
    )
    assert "Traceback" not in said
    assert not (tmp_path / "labelled").exists()


def test_complete_labels_can_still_be_changed(unlabelled, rule, request):
    page = page_of(rule, unlabelled)
    for episode in range(6):
        page.label(episode, None)
    address = request.getfixturevalue("address")
    assert post(f"{address}label", {"episode": 4, "first": 2})[0] == 200
    assert page_of(rule, unlabelled).labels == {**dict.fromkeys(range(6)), 4: 2}


def test_frames_are_those_of_the_dataset(address, unlabelled):
    status, body = get(f"{address}frame?episode=2&frame=4&camera={CAMERA}")
    assert status == 200
    image = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    row = unlabelled.meta.episodes[2]["dataset_from_index"] + 4
    expected = (unlabelled[row][CAMERA].permute(1, 2, 0).numpy() * 255).round()
    assert np.abs(image - expected).mean() < 6


@pytest.mark.parametrize(
    ("path", "content", "status", "said"),
    [
        ("label", {"episode": 6, "first": 0}, 400, "episode=6: must be a whole number from 0 to 5"),
        ("label", {"episode": "1", "first": 0}, 400, "must be a whole number from 0 to 5"),
        ("label", {"episode": 0, "first": 99}, 400, "first=99: must be a whole number from 0 to"),
        ("label", {"episode": 0}, 400, "must have an episode and a first frame"),
        ("label", [], 400, "must have an episode"),
        ("label", b"{", 400, "Expecting"),
        ("finish", {}, 409, "6 episodes have no label"),
        ("nothing", {}, 404, ""),
    ],
)
def test_what_cannot_be_is_refused(address, rule, path, content, status, said):
    found = post(f"{address}{path}", content)
    assert found[0] == status
    assert said in found[1]
    assert not rule.file.exists()


@pytest.mark.parametrize(
    "query",
    [
        "",
        "episode=0&frame=0",
        f"episode=9&frame=0&camera={CAMERA}",
        f"episode=0&frame=-1&camera={CAMERA}",
        "episode=0&frame=0&camera=../x",
    ],
)
def test_frames_that_are_not_there_are_not_found(address, query):
    assert get(f"{address}frame?{query}")[0] == 404


def test_another_site_cannot_label(address):
    assert post(f"{address}label", {"episode": 0, "first": 0}, Origin="http://evil.example")[0] == 403


def test_labels_of_another_dataset_are_refused(rule, unlabelled, small_dataset):
    page_of(rule, unlabelled).label(0, 1)
    with pytest.raises(FieldError, match=r"^file=.*: holds the labels of .*; choose another file"):
        page_of(rule, small_dataset)


def test_labels_of_what_was_recorded_there_before_are_refused(rule, small_dataset, tmp_path):
    """Episodes of the same lengths, in the same folder."""
    shutil.copytree(small_dataset.root, tmp_path / "data")
    page_of(rule, open_dataset(tmp_path / "data")).label(0, 1)
    shutil.rmtree(tmp_path / "data")
    shorter = (np.arange(len(small_dataset)) % 20 > 3).tolist()
    relabelled(Path(small_dataset.root), tmp_path / "data", {"next.success": shorter})
    with pytest.raises(FieldError, match=r"^file=.*: holds the labels of .*data with other episodes"):
        page_of(rule, open_dataset(tmp_path / "data"))


def test_a_dataset_may_be_moved_while_it_is_labelled(rule, small_dataset, tmp_path):
    shutil.copytree(small_dataset.root, tmp_path / "data")
    page_of(rule, open_dataset(tmp_path / "data")).label(0, 1)
    (tmp_path / "data").rename(tmp_path / "moved")
    assert page_of(rule, open_dataset(tmp_path / "moved")).labels == {0: 1}


@pytest.mark.parametrize(("episode", "first"), [("0", 500), ("6", 1), ("1", "2"), ("1", -1), ("1", True)])
def test_a_label_in_the_file_that_cannot_be_is_named(rule, unlabelled, episode, first):
    page_of(rule, unlabelled).label(3, 2)
    stored = json.loads(rule.file.read_text())
    rule.file.write_text(json.dumps(stored | {"labels": {**stored["labels"], episode: first}}))
    with pytest.raises(FieldError, match=rf"^file=.*: the label {episode}: {json.dumps(first)} cannot be \("):
        page_of(rule, unlabelled)


def test_a_file_that_holds_no_labels_is_refused(rule, unlabelled):
    rule.file.write_text("[1, 2]")
    with pytest.raises(FieldError, match=r"^file=.*: holds no labels"):
        page_of(rule, unlabelled)


def test_a_key_that_is_held_down_and_a_slow_server_label_what_was_seen(address, chromium, rule, unlabelled):
    chromium.switch_to.new_window("window")
    chromium.get(address)
    wait(lambda: chromium.find_element(By.ID, "status").text == "ready")
    chromium.execute_script(
        """
        const send = window.fetch;
        const later = () => new Promise((done) => setTimeout(done, 150));
        window.fetch = async (...given) => { await later(); return send(...given); };
        const press = (code, repeat) => dispatchEvent(new KeyboardEvent("keydown", { code, repeat }));
        press("KeyS", false); press("KeyS", true); press("KeyS", true); press("KeyF", false);
        """
    )
    wait(lambda: len(page_of(rule, unlabelled).labels) == 2)
    labels = page_of(rule, unlabelled).labels
    assert labels == {0: int(read_episodes(unlabelled).length[0]) - 3, 1: None}
