"""Publishing with the real client to a hub on the loopback: file by file, loaded again, repeated, refused."""

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from huggingface_hub import HfApi, constants
from lerobot.datasets.dataset_metadata import CODEBASE_VERSION
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.publishing import publish
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from tests.hub_server import BRANCH, READ_TOKEN, WRITE_TOKEN, Hub, running_hub
from tests.lerobot_dataset_maniskill.made_up import ROWS, record_made_up

NAME = "somebody/pushes"
EPISODES = 3
FLAGS = [
    f"--num_episodes={EPISODES}",
    "--part_episodes=2",
    "--kinds={optimal: 2, near_miss: 1}",
    "--env.type=wmrl_maniskill",
    "--env.image_size=32",
    "--env.cameras=[third_view,wrist]",
]

LOAD = """
import json, sys
import datasets
from lerobot.datasets.lerobot_dataset import LeRobotDataset

name, row = sys.argv[1], int(sys.argv[2])
dataset, table = LeRobotDataset(name), datasets.load_dataset(name, split="train")
item = dataset[row]
print(json.dumps({
    "root": str(dataset.root), "frames": len(dataset), "episodes": dataset.num_episodes, "rows": len(table),
    "action": item["action"].tolist(), "picture": item["observation.images.wrist"].tolist(),
    "task": item["task"], "table_action": table[row]["action"], "table_scene": table[row]["start.scene"],
}))
"""


@pytest.fixture
def hub() -> Iterator[Hub]:
    with running_hub() as hub:
        yield hub


@pytest.fixture
def without_xet(monkeypatch: pytest.MonkeyPatch) -> None:
    """What HF_HUB_DISABLE_XET=1 does at import: large files go as LFS, which the hub here speaks."""
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the command would have recorded with `FLAGS`."""
    config = RecordConfig(
        output_dir=tmp_path_factory.mktemp("recorded") / "dataset",
        num_episodes=EPISODES,
        part_episodes=2,
        kinds={"optimal": 2, "near_miss": 1},
        env=WmrlManiSkillEnv(image_size=32, cameras=["third_view", "wrist"]),
    )
    record_made_up(config)
    return config.root


@pytest.fixture(scope="module")
def published(root: Path) -> Iterator[Hub]:
    """A hub to which the command has published."""
    with running_hub() as hub:
        flags = [*FLAGS, f"--output_dir={root}", f"--repo_id={NAME}", "--push_to_hub=true", "--private=true"]
        said = run_at(hub, root.parent / "pushing", "-m", "lerobot_dataset_maniskill.record", *flags)
        assert f"{root} is already recorded: {EPISODES} episodes" in said
        assert f"published: {hub.url}/datasets/{NAME}" in said
        yield hub


def run_at(hub: Hub, home: Path, *arguments: str) -> str:
    """What Python prints in a process of its own that knows no other hub, and has an empty cache."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith("HF_")}
    own = {"HF_ENDPOINT": hub.url, "HF_HOME": str(home), "HF_TOKEN": WRITE_TOKEN, "HF_HUB_DISABLE_XET": "1"}
    done = subprocess.run(
        [sys.executable, *arguments], env={**kept, **own}, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def digests(files: dict[str, bytes]) -> dict[str, str]:
    return {path: hashlib.sha256(content).hexdigest() for path, content in files.items()}


def local_files(root: Path) -> dict[str, bytes]:
    """Path in the dataset → content."""
    files = (path for path in root.rglob("*") if path.is_file())
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}


def test_the_hub_holds_the_folder_file_by_file(published: Hub, root: Path) -> None:
    repo, local = published.dataset(NAME), local_files(root)
    held = {path: content for path, content in repo.head.items() if path != ".gitattributes"}
    assert digests(held) == digests(local)
    assert {"README.md", "meta/wmrl.json", "media/push.png"} <= set(held)
    assert f"# {NAME}" in held["README.md"].decode()
    assert repo.private


def test_the_tag_by_which_lerobot_looks_is_on_the_head(published: Hub) -> None:
    refs = published.dataset(NAME).refs
    assert refs[CODEBASE_VERSION] == refs[BRANCH]


def test_plain_lerobot_and_datasets_load_it(published: Hub, root: Path, tmp_path: Path) -> None:
    row = ROWS + 3
    loaded = json.loads(run_at(published, tmp_path, "-c", LOAD, NAME, str(row)).splitlines()[-1])
    local = LeRobotDataset(NAME, root=root)
    assert Path(loaded["root"]).is_relative_to(tmp_path)
    assert loaded["frames"] == loaded["rows"] == len(local) == EPISODES * ROWS
    assert loaded["episodes"] == EPISODES
    assert loaded["task"] == local[row]["task"] == "push it"
    assert np.array_equal(loaded["picture"], local[row]["observation.images.wrist"].numpy())
    assert loaded["action"] == loaded["table_action"] == local[row]["action"].tolist()
    assert loaded["table_scene"] == local[row]["start.scene"].item()


@pytest.mark.usefixtures("without_xet")
def test_published_again_nothing_is_sent(published: Hub, root: Path) -> None:
    commits = len(published.dataset(NAME).commits)
    first = len(published.requests)
    publish(HfApi(published.url, WRITE_TOKEN), root, NAME, private=True)
    assert len(published.dataset(NAME).commits) == commits
    again = published.requests[first:]
    assert not any(method == "PUT" or "/commit/" in path for method, path in again)


@pytest.mark.usefixtures("without_xet")
def test_files_of_an_earlier_recording_are_gone(hub: Hub, root: Path) -> None:
    api = HfApi(hub.url, WRITE_TOKEN)
    api.create_repo(NAME, repo_type="dataset")
    repo, stale = hub.dataset(NAME), "data/chunk-000/file-999.parquet"
    repo.commit({**repo.head, stale: b"old", "LICENSE": b"ours"})
    publish(api, root, NAME, private=False)
    assert stale not in repo.head
    assert repo.head["LICENSE"] == b"ours"
    assert set(local_files(root)) <= set(repo.head)


@pytest.mark.usefixtures("without_xet")
@pytest.mark.parametrize(
    ("token", "message"),
    [
        ("hf_unknown", r"push_to_hub=true: .* \(401, Invalid username or password\.\).*`hf auth login`"),
        (READ_TOKEN, r"push_to_hub=true: .* \(403, .*`hf auth login`"),
    ],
)
def test_without_permission_the_recording_stays_and_can_be_published_later(
    hub: Hub, root: Path, token: str, message: str
) -> None:
    before = digests(local_files(root))
    with pytest.raises(ValueError, match=rf"{message}.*the recording is whole in .*only publishes it"):
        publish(HfApi(hub.url, token), root, NAME, private=False)
    assert not hub.repos
    publish(HfApi(hub.url, WRITE_TOKEN), root, NAME, private=False)
    assert digests(local_files(root)).items() == before.items() <= digests(hub.dataset(NAME).head).items()


def test_a_hub_that_cannot_be_reached_is_named_as_the_reason(hub: Hub, root: Path) -> None:
    with running_hub() as gone:
        pass
    with pytest.raises(ValueError, match=r"push_to_hub=true: .*cannot be reached .*only publishes it"):
        publish(HfApi(gone.url, WRITE_TOKEN), root, NAME, private=False)


def test_what_is_public_is_not_called_private(hub: Hub, root: Path) -> None:
    api = HfApi(hub.url, WRITE_TOKEN)
    api.create_repo(NAME, repo_type="dataset")
    with pytest.raises(ValueError, match=r"private=true: somebody/pushes is public"):
        publish(api, root, NAME, private=True)
    assert list(hub.dataset(NAME).head) == [".gitattributes"]


@pytest.mark.parametrize(
    ("repo_id", "message"),
    [
        (None, "called local/dataset; give its name on the hub, user/name, as `repo_id`"),
        ("pushes", "called pushes; give its name"),
        ("somebody/push/es", "repo_id=somebody/push/es"),
        (NAME, "nobody is logged in to the hub here; run hf auth login"),
    ],
)
def test_what_cannot_be_published_is_refused_before_it_is_recorded(
    repo_id: str | None, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for variable in ("HF_TOKEN", "HUGGING_FACE_HUB_TOKEN"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(tmp_path / "token"))
    with pytest.raises(ValueError, match=message):
        RecordConfig(output_dir=tmp_path / "dataset", repo_id=repo_id, push_to_hub=True).validate()
