"""Labels by hand: a page that shows a dataset's episodes, on which somebody says where they succeed.

`--success.type=by_hand` of lerobot-wmrl-label.
"""

import asyncio
import json
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from lerobot_wmrl.common.errors import FieldError, Stopped, require_at_least
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.play.checks import LAST_PORT, whole_number
from lerobot_wmrl.rewards.success_rules import SuccessRule, frame_positions, next_frame_solved

if TYPE_CHECKING:
    from aiohttp import web
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

KEPT_FRAMES: Final = 2048
"""Frames that stay encoded in memory, for going to and fro."""

Labels = dict[int, int | None]
"""Episode → the first frame in which the task is solved, None for a failure. What is missing has no label."""


@SuccessRule.register_subclass("by_hand")
@dataclass
class ByHandRule(SuccessRule):
    """What somebody says on a page that shows the episodes: key S for success, F for failure.

    Args:
        file: where the labels are kept while they are made. The same command goes on with them.
        last: how many of the last frames of an episode count if it succeeds; on the page any other frame can
            be chosen.
        host: address at which the page is served.
        port: port at which the page is served; 0 for any that is free.
    """

    file: Path = Path("outputs/labels.json")
    last: int = 3
    host: str = "127.0.0.1"
    port: int = 8000

    def __post_init__(self) -> None:
        require_at_least(self, 1, "last")
        whole_number("port", self.port, LAST_PORT)

    def labels(self, dataset: "LeRobotDataset") -> np.ndarray:
        from lerobot_wmrl.play.web import serve

        page = LabelPage(self, dataset)
        try:
            serve(page.application(), page.access, self.port, "its button goes on", page.finished)
        except KeyboardInterrupt as interrupt:
            raise Stopped(
                f"{len(page.labels)} of {len(page.lengths)} episodes have a label, kept in {self.file}; "
                "the same command goes on"
            ) from interrupt
        return next_frame_solved(solved_frames(page.labels, dataset), dataset)


class LabelPage:
    """The page's server, and the labels.

    Args:
        rule: its settings.
        dataset: dataset whose episodes are labelled.

    Raises:
        FieldError: the file holds the labels of another dataset.
    """

    def __init__(self, rule: ByHandRule, dataset: "LeRobotDataset") -> None:
        from lerobot_wmrl.play.web import Access

        self.rule, self.dataset, self.access = rule, dataset, Access(rule.host)
        self.lengths = [int(row["length"]) for row in dataset.meta.episodes]
        self.about = {"dataset": str(Path(dataset.root).resolve()), "lengths": self.lengths}
        self.labels = self._read()
        self.done = asyncio.Event()
        self.worker = ThreadPoolExecutor(1, "frames")
        self.cameras = [key for key in dataset.meta.camera_keys if key not in dataset.meta.depth_keys]
        self.pictures = lru_cache(KEPT_FRAMES)(self._pictures)

    @property
    def complete(self) -> bool:
        """Whether every episode has a label."""
        return len(self.labels) == self.dataset.meta.total_episodes

    async def finished(self) -> None:
        """Wait until somebody says that the labels are complete."""
        await self.done.wait()

    def application(self) -> "web.Application":
        """Return the web application."""
        from aiohttp import web

        return self.access.application(
            "label.html", web.get("/dataset", self._describe), web.get("/frame", self._frame),
            web.post("/label", self._label), web.post("/finish", self._finish),
        )  # fmt: skip

    def label(self, episode: Any, first: Any) -> None:
        """Label an episode, and write the file.

        Args:
            episode: its index.
            first: first frame in which the task is solved; None for a failure, "none" to take a label back.

        Raises:
            FieldError: there is no such episode or frame.
        """
        index = whole_number("episode", episode, len(self.lengths) - 1)
        if first == "none":
            self.labels.pop(index, None)
        elif first is None:
            self.labels[index] = None
        else:
            self.labels[index] = whole_number("first", first, self.lengths[index] - 1)
        write_json(self.rule.file, {**self.about, "labels": self.labels})

    async def _describe(self, request: "web.Request") -> "web.Response":
        from aiohttp import web

        tasks = [", ".join(row["tasks"]) for row in self.dataset.meta.episodes]
        return web.json_response(
            {
                "fps": self.dataset.fps, "cameras": self.cameras,
                "lengths": self.lengths, "tasks": tasks, "labels": self.labels, "last": self.rule.last,
            }
        )  # fmt: skip

    async def _frame(self, request: "web.Request") -> "web.Response":
        from aiohttp import web

        camera = request.query.get("camera", "")
        asked = (request.query.get(name, "") for name in ("episode", "frame"))
        numbers = [int(each) if each.isdecimal() else each for each in asked]
        if camera not in self.cameras:
            raise web.HTTPNotFound(text=f"there is no camera {camera!r}")
        try:
            episode = whole_number("episode", numbers[0], len(self.lengths) - 1)
            frame = whole_number("frame", numbers[1], self.lengths[episode] - 1)
        except FieldError as error:
            raise web.HTTPNotFound(text=str(error)) from error
        loop = asyncio.get_running_loop()
        row = int(self.dataset.meta.episodes[episode]["dataset_from_index"]) + frame
        pictures = await loop.run_in_executor(self.worker, self.pictures, row)
        return web.Response(body=pictures[camera], content_type="image/jpeg")

    def _pictures(self, row: int) -> dict[str, bytes]:
        """Return the pictures of a row of the dataset by camera, as JPEG."""
        from lerobot_wmrl.common.images import jpeg, to_pixels

        found = self.dataset[row]
        return {camera: jpeg(to_pixels(found[camera])) for camera in self.cameras}

    async def _label(self, request: "web.Request") -> "web.Response":
        from aiohttp import web

        try:
            message = await request.json()
            if not isinstance(message, Mapping) or "first" not in message:
                raise FieldError("label", message, "must have an episode and a first frame")
            self.label(message.get("episode"), message["first"])
        except ValueError as error:
            raise web.HTTPBadRequest(text=str(error)) from error
        return web.json_response({"labelled": len(self.labels)})

    async def _finish(self, request: "web.Request") -> "web.Response":
        from aiohttp import web

        if not self.complete:
            missing = len(self.lengths) - len(self.labels)
            raise web.HTTPConflict(text=f"{missing} episodes have no label")
        await request.read()  # else the server may wait ten seconds for the rest of it before it ends
        self.done.set()
        return web.json_response({})

    def _read(self) -> Labels:
        if not self.rule.file.is_file():
            return {}
        try:
            found = json.loads(self.rule.file.read_text())
            labels = {int(episode): first for episode, first in found["labels"].items()}
            own = {name: found[name] for name in self.about} == self.about
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise FieldError("file", self.rule.file, "holds no labels", "choose another file") from error
        if not own:
            raise FieldError(
                "file", self.rule.file, f"holds the labels of {found['dataset']}, as it was then",
                "choose another file",
            )  # fmt: skip
        return labels


def solved_frames(labels: Mapping[int, int | None], dataset: "LeRobotDataset") -> np.ndarray:
    """Mark the frames in which the task is solved. (N,)"""
    episode, frame, _ = frame_positions(dataset)
    never = np.iinfo(np.int64).max
    first = {index: never if begins is None else begins for index, begins in labels.items()}
    return np.asarray(frame >= np.array([first.get(int(index), never) for index in episode]))
