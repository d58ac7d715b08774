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

from lerobot_wmrl.common.errors import FieldError, require_at_least
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.rewards.success_rules import SuccessRule, rows_of

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
        require_at_least(self, 0, "port")

    def frames(self, dataset: "LeRobotDataset") -> np.ndarray:
        from lerobot_wmrl.play.web import serve

        page = LabelPage(self, dataset)

        def ready(port: int) -> None:
            print(f"open {page.access.address(port)} in a browser; its button goes on", flush=True)

        if not page.complete:
            try:
                serve(page.application(), self.host, self.port, ready, page.finished)
            except OSError as error:
                raise FieldError(
                    "port", self.port, f"cannot be served ({error})", "choose another"
                ) from error
        return solved_frames(page.labels, dataset)


class LabelPage:
    """The page's server, and the labels.

    Args:
        rule: its settings.
        dataset: whose episodes are labelled.

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

        from lerobot_wmrl.play.web import PAGES

        app = web.Application(middlewares=[self.access.guard])
        app.router.add_get("/", self._page)
        app.router.add_get("/dataset", self._describe)
        app.router.add_get("/frame", self._frame)
        app.router.add_post("/label", self._label)
        app.router.add_post("/finish", self._finish)
        app.router.add_static("/static", PAGES)
        return app

    def label(self, episode: Any, first: Any) -> None:
        """Label an episode, and write the file.

        Args:
            episode: its index.
            first: first frame in which the task is solved; None for a failure, "none" to take a label back.

        Raises:
            FieldError: there is no such episode or frame.
        """
        if not is_index(episode, len(self.lengths)):
            raise FieldError("episode", episode, f"must be from 0 to {len(self.lengths) - 1}")
        if first == "none":
            self.labels.pop(episode, None)
        elif first is None or is_index(first, self.lengths[episode]):
            self.labels[episode] = first
        else:
            raise FieldError("first", first, f"must be from 0 to {self.lengths[episode] - 1}, or null")
        write_json(self.rule.file, {**self.about, "labels": self.labels})

    async def _page(self, request: "web.Request") -> "web.Response":
        return self.access.page("label.html")

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
        numbers = [request.query.get(name, "") for name in ("episode", "frame")]
        episode, frame = (int(each) if each.isdecimal() else -1 for each in numbers)
        if camera not in self.cameras or not is_index(episode, len(self.lengths)):
            raise web.HTTPNotFound(text=f"there is no camera {camera!r} or no episode {numbers[0]!r}")
        if not is_index(frame, self.lengths[episode]):
            raise web.HTTPNotFound(text=f"frame: episode {episode} has {self.lengths[episode]} frames")
        loop = asyncio.get_running_loop()
        row = int(self.dataset.meta.episodes[episode]["dataset_from_index"]) + frame
        pictures = await loop.run_in_executor(self.worker, self.pictures, row)
        return web.Response(body=pictures[camera], content_type="image/jpeg")

    def _pictures(self, row: int) -> dict[str, bytes]:
        """Return the pictures of a row of the dataset by camera, as JPEG."""
        from lerobot_wmrl.common.images import jpeg, to_bytes

        found = self.dataset[row]
        return {
            camera: jpeg(to_bytes(found[camera].float()).permute(1, 2, 0).numpy()) for camera in self.cameras
        }

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


def is_index(value: Any, count: int) -> bool:
    """Return whether this is a whole number from 0 to below `count`."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < count


def solved_frames(labels: Mapping[int, int | None], dataset: "LeRobotDataset") -> np.ndarray:
    """Mark the frames in which the task is solved. (N,)"""
    episode, frame, _ = rows_of(dataset)
    never = np.iinfo(np.int64).max
    first = {index: never if begins is None else begins for index, begins in labels.items()}
    return np.asarray(frame >= np.array([first.get(int(index), never) for index in episode]))
