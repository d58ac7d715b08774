"""What the pages of this package share: who may see them, and how they are served."""

import asyncio
import secrets
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, Final

from aiohttp import web

PAGES: Final = Path(__file__).with_name("page")
LOOPBACK: Final = ("127.0.0.1", "localhost", "::1")
TOKEN: Final = "token"
SOURCES: Final = (
    "default-src 'self'",
    "img-src 'self' data: blob:",
    "connect-src 'self' data: ws: wss:",
    "frame-ancestors 'none'",
)
"""Where a page may load from, and that no other page shows it; frames come as data."""

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Access:
    """Who may see a page.

    Args:
        host: address at which it is served. Beyond this machine, visitors need a token.
    """

    def __init__(self, host: str) -> None:
        self.host = host
        self.token = "" if host in LOOPBACK else secrets.token_urlsafe(16)

    @web.middleware
    async def guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse visitors without the token, and pages of other sites.

        On the loopback, where there is no token, a foreign page could reach this server under a name of its
        own that leads here (DNS rebinding), so the host must be this machine's.
        """
        if self.token:
            given = request.query.get(TOKEN) or request.cookies.get(TOKEN, "")
            if not secrets.compare_digest(given.encode(), self.token.encode()):
                raise web.HTTPUnauthorized(text="open the address with ?token=… that the command has printed")
        elif host_name(request.host) not in LOOPBACK:
            raise web.HTTPForbidden(text=f"the host {request.host} is not this machine")
        origin = request.headers.get("Origin")
        if origin is not None and origin.partition("://")[2] != request.host:
            raise web.HTTPForbidden(text=f"{origin} is another site")
        return await handler(request)

    def page(self, name: str) -> web.Response:
        """Return a page, by the name of its file."""
        page = web.Response(text=(PAGES / name).read_text(), content_type="text/html")
        page.headers["Cache-Control"] = "no-store"
        page.headers["Content-Security-Policy"] = "; ".join(SOURCES)
        if self.token:
            page.set_cookie(TOKEN, self.token, httponly=True, samesite="Strict")
        return page

    def address(self, port: int) -> str:
        """Return the page's address."""
        shown = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{shown}:{port}/" + (f"?{TOKEN}={self.token}" if self.token else "")


def host_name(host: str) -> str:
    """Return the name in a Host header, without the port."""
    return host.partition("]")[0].strip("[") if host.startswith("[") else host.partition(":")[0]


async def forever() -> None:
    """Wait until interrupted."""
    await asyncio.Event().wait()


def serve(
    app: web.Application, host: str, port: int, ready: Callable[[int], None],
    finished: Callable[[], Awaitable[Any]] = forever,
) -> None:  # fmt: skip
    """Serve until interrupted. OSError if the address is taken.

    Args:
        app: the web application.
        host, port: where; port 0 for any that is free.
        ready: is given the port when the page can be opened there.
        finished: is awaited, and ends the service.
    """

    async def run() -> None:
        runner = web.AppRunner(app, access_log=None)
        await runner.setup()
        try:
            await web.TCPSite(runner, host, port).start()
            ready(runner.addresses[0][1])
            await finished()
        finally:
            await runner.cleanup()

    asyncio.run(run())
