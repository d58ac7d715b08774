"""The page's server: static files, a socket for each visitor, and uploads.

Everything that computes runs in one thread, in the order in which it was asked for: the models are shared,
and a simulator belongs to the thread that made it.
"""

import asyncio
import json
import logging
import secrets
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import IO, Any, Final

from aiohttp import WSCloseCode, WSMsgType, web
from PIL import Image, UnidentifiedImageError

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.play.checks import instruction
from lerobot_wmrl.play.saving import SavedEpisodes
from lerobot_wmrl.play.visit import Visit
from lerobot_wmrl.play.web import Access
from lerobot_wmrl.play.world import LARGEST_SIDE, World

MOST_VISITORS: Final = 8
"""Visitors whose drives are kept; the one who has been away longest makes room for the next."""

ELSEWHERE: Final = 4000
"""Code with which a socket is closed when its visitor has opened the page once more."""

MOST_UPLOADS: Final = 16
LARGEST_MESSAGE: Final = 64 * 1024
LARGEST_UPLOAD: Final = 16 * 1024**2
FORMATS: Final = ("PNG", "JPEG", "WEBP")


class PlayServer:
    """Serves the page.

    Args:
        world: what all visitors share.
        saved: where episodes are saved.
        host: address to listen at. Beyond this machine, visitors need the token.
    """

    def __init__(self, world: World, saved: SavedEpisodes, host: str) -> None:
        self.world, self.saved, self.access = world, saved, Access(host)
        self.visits: dict[str, Visit] = {}
        self.sockets: dict[str, web.WebSocketResponse] = {}
        self.entering = asyncio.Lock()
        self.worker = ThreadPoolExecutor(1, "drive")

    def application(self) -> web.Application:
        """Return the web application."""
        app = self.access.application(
            "index.html",
            web.get("/world", self._describe),
            web.get("/drive", self._drive),
            web.post("/picture", self._picture),
            largest=LARGEST_UPLOAD,
        )
        app.on_shutdown.append(self._disconnect)
        app.on_cleanup.append(self._close)
        return app

    async def _compute[Result](self, function: Callable[..., Result], *arguments: Any) -> Result:
        return await asyncio.get_running_loop().run_in_executor(self.worker, function, *arguments)

    async def _disconnect(self, app: web.Application) -> None:
        """Close the sockets, which would hold up the end of the server otherwise."""
        for socket in list(self.sockets.values()):
            await socket.close(code=WSCloseCode.GOING_AWAY)

    async def _close(self, app: web.Application) -> None:
        for visit in self.visits.values():
            await self._compute(visit.close)
        self.worker.shutdown()

    async def _describe(self, request: web.Request) -> web.Response:
        return web.json_response(self.world.description())

    async def _drive(self, request: web.Request) -> web.WebSocketResponse:
        """Answer a visitor's messages. Under the same name they find their drive again."""
        name = request.query.get("visit", "")
        if not (name.isalnum() and 8 <= len(name) <= 64):
            raise web.HTTPBadRequest(text="visit: must be 8 to 64 letters and digits")
        if name not in self.sockets and len(self.sockets) >= MOST_VISITORS:
            raise web.HTTPServiceUnavailable(text=f"{MOST_VISITORS} visitors are here already")
        socket = web.WebSocketResponse(max_msg_size=LARGEST_MESSAGE, heartbeat=30)
        await socket.prepare(request)
        before, self.sockets[name] = self.sockets.get(name), socket
        try:
            if before is not None:
                await before.close(code=ELSEWHERE)
            async with self.entering:
                visit = await self._visit(name)
            async for received in socket:
                if received.type is WSMsgType.TEXT:
                    await socket.send_json(await self._answer(visit, received.data))
        finally:
            if self.sockets.get(name) is socket:
                del self.sockets[name]
        return socket

    async def _visit(self, name: str) -> Visit:
        """Return a visitor's visit, a new one if they have not been here."""
        visit = self.visits.pop(name, None)
        if visit is None:
            away = [each for each in self.visits if each not in self.sockets]
            if len(self.visits) >= MOST_VISITORS and away:
                await self._compute(self.visits.pop(away[0]).close)
            visit = await self._compute(Visit, self.world, self.saved)
        self.visits[name] = visit
        return visit

    async def _answer(self, visit: Visit, data: str) -> dict[str, Any]:
        """Return the answer to a message, or what is wrong with it."""
        try:
            message = json.loads(data)
            if not isinstance(message, dict):
                raise FieldError("message", data[:80], "must be a JSON object")
            return await self._compute(visit.answer, message)
        except ValueError as error:
            return {"error": str(error)}
        except Exception as error:  # a policy's or an environment's own
            logging.exception("a message could not be answered")
            return {"error": f"{type(error).__name__}: {error}"}

    async def _picture(self, request: web.Request) -> web.Response:
        """Take pictures, one for each camera, with `state` and `instruction`. → the name of the place."""
        if not request.content_type.startswith("multipart/"):
            raise web.HTTPUnsupportedMediaType(text="send a form (multipart/form-data)")
        try:
            form = await request.post()
            files = [(name, part.file) for name, part in form.items() if isinstance(part, web.FileField)]
            cameras = self.world.tokenizer_config.cameras
            if (names := sorted(name for name, _ in files)) != sorted(cameras):
                raise FieldError(
                    "picture",
                    names,
                    f"the world model sees the cameras {', '.join(cameras)}",
                    "give one picture for each",
                )
            images = {name: read_image(name, file) for name, file in files}
            state = json.loads(str(form["state"])) if "state" in form else None
            task = instruction(str(form.get("instruction", "")))
            name = secrets.token_hex(8)
            await self._compute(self.world.upload, name, images, state, task)
        except ValueError as error:
            raise web.HTTPBadRequest(text=str(error)) from error
        while len(self.world.uploads) > MOST_UPLOADS:
            self.world.uploads.pop(next(iter(self.world.uploads)))
        return web.json_response({"picture": name})


def read_image(name: str, file: IO[bytes]) -> Image.Image:
    """Open an uploaded picture, which is not decoded here. FieldError if it is none, or too large."""
    try:
        image = Image.open(file, formats=FORMATS)
        if max(image.size) > LARGEST_SIDE:
            raise FieldError(
                "picture", name, f"has {image.size} pixels", f"send at most {LARGEST_SIDE} a side"
            )
    except (UnidentifiedImageError, OSError, Image.DecompressionBombError) as error:
        raise FieldError("picture", name, "cannot be read", f"send {', '.join(FORMATS)}") from error
    return image
