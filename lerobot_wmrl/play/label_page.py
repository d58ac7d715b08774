"""The page that shows a dataset's episodes, on which somebody says where they succeed."""

import asyncio
import json
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from aiohttp import web
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.images import jpeg, to_pixels
from lerobot_wmrl.data.dataset import fingerprint
from lerobot_wmrl.play.checks import whole_number
from lerobot_wmrl.play.web import Access
from lerobot_wmrl.rewards.success_rules import frame_positions

KEPT_FRAMES: Final = 2048
"""Frames that stay encoded in memory, for going to and fro."""

Labels = dict[int, int | None]
"""Episode → the first frame in which the task is solved, None for a failure. What is missing has no label."""


class LabelPage:
    """The page's server, and the labels.

    Args:
        file: where the labels are kept while they are made.
        last: how many of the last frames of an episode count if it succeeds, unless another is chosen.
        host: address at which the page is served.
        dataset: dataset whose episodes are labelled.

    Raises:
        FieldError: the file holds the labels of another dataset, or one that cannot be.
    """

    def __init__(self, file: Path, last: int, host: str, dataset: LeRobotDataset) -> None:
        self.file, self.last, self.dataset, self.access = file, last, dataset, Access(host)
        self.lengths = [int(row["length"]) for row in dataset.meta.episodes]
        root = Path(dataset.root)
        self.about = {
            "dataset": str(root.resolve()),
            "content": fingerprint(root, meta=False),
            "lengths": self.lengths,
        }
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

    def application(self) -> web.Application:
        """Return the web application."""
        return self.access.application(
            "label.html",
            web.get("/dataset", self._describe),
            web.get("/frame", self._frame),
            web.post("/label", self._label),
            web.post("/finish", self._finish),
        )

    def label(self, episode: Any, first: Any) -> None:
        """Label an episode, and write the file.

        Args:
            episode: its index.
            first: first frame in which the task is solved; None for a failure, "none" to take a label back.

        Raises:
            FieldError: there is no such episode or frame.
        """
        if first == "none":
            self.labels.pop(whole_number("episode", episode, len(self.lengths) - 1), None)
        else:
            self.labels |= self._checked(episode, first)
        write_json(self.file, {**self.about, "labels": self.labels})

    def _checked(self, episode: Any, first: Any) -> Labels:
        """Return the label of one episode. FieldError if there is no such episode or frame."""
        index = whole_number("episode", episode, len(self.lengths) - 1)
        return {index: None if first is None else whole_number("first", first, self.lengths[index] - 1)}

    async def _describe(self, request: web.Request) -> web.Response:
        tasks = [", ".join(row["tasks"]) for row in self.dataset.meta.episodes]
        return web.json_response(
            {
                "fps": self.dataset.fps,
                "cameras": self.cameras,
                "lengths": self.lengths,
                "tasks": tasks,
                "labels": self.labels,
                "last": self.last,
            }
        )

    async def _frame(self, request: web.Request) -> web.Response:
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
        frame = self.dataset[row]
        return {camera: jpeg(to_pixels(frame[camera])) for camera in self.cameras}

    async def _label(self, request: web.Request) -> web.Response:
        try:
            message = await request.json()
            if not isinstance(message, Mapping) or "first" not in message:
                raise FieldError("label", message, "must have an episode and a first frame")
            self.label(message.get("episode"), message["first"])
        except ValueError as error:
            raise web.HTTPBadRequest(text=str(error)) from error
        return web.json_response({"labelled": len(self.labels)})

    async def _finish(self, request: web.Request) -> web.Response:
        if not self.complete:
            missing = len(self.lengths) - len(self.labels)
            raise web.HTTPConflict(text=f"{missing} episodes have no label")
        await request.read()  # else the server may wait ten seconds for the rest of it before it ends
        self.done.set()
        return web.json_response({})

    def _read(self) -> Labels:
        if not self.file.is_file():
            return {}
        try:
            stored = json.loads(self.file.read_text())
            given = {int(episode): first for episode, first in stored["labels"].items()}
            same = all(stored.get(name) == self.about[name] for name in ("content", "lengths"))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise FieldError("file", self.file, "holds no labels", "choose another file") from error
        if not same:
            raise FieldError(
                "file",
                self.file,
                f"holds the labels of {stored.get('dataset')} with other episodes",
                "choose another file",
            )
        labels: Labels = {}
        for episode, first in given.items():
            try:
                labels |= self._checked(episode, first)
            except FieldError as error:
                raise FieldError(
                    "file",
                    self.file,
                    f"the label {episode}: {json.dumps(first)} cannot be ({error})",
                    "correct it there, or take it out",
                ) from error
        return labels


def solved_frames(labels: Mapping[int, int | None], dataset: LeRobotDataset) -> np.ndarray:
    """Mark the frames in which the task is solved. (N,)"""
    episode, frame, _ = frame_positions(dataset)
    never = np.iinfo(np.int64).max
    first = {index: never if begins is None else begins for index, begins in labels.items()}
    return np.asarray(frame >= np.array([first.get(int(index), never) for index in episode]))
