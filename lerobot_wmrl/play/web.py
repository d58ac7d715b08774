"""What the pages of this package share: who may see them, and how they are served."""

import asyncio
import secrets
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, Final

from aiohttp import web

from lerobot_wmrl.common.errors import FieldError

PAGES: Final = Path(__file__).with_name("page")
LOOPBACK: Final = ("127.0.0.1", "localhost", "::1")
TOKEN: Final = "token"
LARGEST: Final = 1024**2
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
            token = request.query.get(TOKEN) or request.cookies.get(TOKEN, "")
            if not secrets.compare_digest(token.encode(), self.token.encode()):
                raise web.HTTPUnauthorized(text="open the address with ?token=… that the command has printed")
        elif host_name(request.host) not in LOOPBACK:
            raise web.HTTPForbidden(text=f"the host {request.host} is not this machine")
        origin = request.headers.get("Origin")
        if origin is not None and origin.partition("://")[2] != request.host:
            raise web.HTTPForbidden(text=f"{origin} is another site")
        return await handler(request)

    def application(self, page: str, *routes: web.RouteDef, largest: int = LARGEST) -> web.Application:
        """Return a guarded web application.

        Args:
            page: name of the file that is served as `/`.
            routes: what else there is, beside the files of the pages.
            largest: bytes of a request.
        """

        async def show(request: web.Request) -> web.Response:
            return self.page(page)

        app = web.Application(client_max_size=largest, middlewares=[self.guard])
        app.add_routes([web.get("/", show), *routes, web.static("/static", PAGES)])
        return app

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
    app: web.Application,
    access: Access,
    port: int,
    until: str,
    finished: Callable[[], Awaitable[Any]] = forever,
) -> None:
    """Serve until interrupted, and print the address.

    Args:
        app: the web application.
        access: says where.
        port: 0 for any that is free.
        until: what ends it, printed with the address.
        finished: is awaited, and ends the service.

    Raises:
        FieldError: nothing can be served there.
    """

    async def run() -> None:
        runner = web.AppRunner(app, access_log=None)
        await runner.setup()
        try:
            try:
                await web.TCPSite(runner, access.host, port).start()
            except OSError as error:
                raise FieldError(
                    "port",
                    port,
                    f"cannot be served at {access.host} ({error})",
                    "choose another port, or `host`",
                ) from error
            print(f"open {access.address(runner.addresses[0][1])} in a browser; {until}", flush=True)
            await finished()
        finally:
            await runner.cleanup()

    asyncio.run(run())
