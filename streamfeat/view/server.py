"""The server of the page: one port of this machine for the page, what it shows, and what it asks for.

Lives here: HTTP and WebSocket on loopback, and what a slow browser misses.
Not here: who may connect (`gate`), what is shown (`sink`), what buttons do (`job`), the page (`page`).

The address holds a token that is made anew for each view. Without it, with another `Host` (a name that was
bound to this machine from outside) or from a page of another origin, nothing is given. Of each thing that is
shown a browser gets the latest; what it had no time for is left out, and holds up nothing.

A message to the browser is text, `{"camera", "channel", "record"}`, or bytes: the length of a JSON header in
two bytes, the header `{"camera", "channel", "width", "height"}`, and a byte a pixel. A message from
the browser is text, `{"op": ..., "value": ...}`, of 4,096 bytes at most.
"""

import asyncio
import json
import os
import struct
from collections.abc import Callable
from contextlib import suppress
from threading import Event, Thread
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray
from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from streamfeat.errors import InputError
from streamfeat.view.gate import MAX_CLIENTS, Gate

__all__ = ["PageServer"]

_MAX_ASKED_BYTES = 4096
_MAX_CAMERAS = 64


class PageServer:
    """Serves a page, and shows on it what it is told.

    Args:
        make_page: the page, given the port and the token.
        port: on 127.0.0.1; 0 for any that is free.
        on_viewer: called, in the server's thread, when a browser connects.
        on_asked: called there with each message of a browser, a JSON object.

    Attributes:
        port: where it listens.
        address: what to open in a browser.

    Raises:
        InputError: the port cannot be used.
    """

    def __init__(
        self,
        make_page: Callable[[int, str], str],
        port: int,
        *,
        on_viewer: Callable[[], None] = lambda: None,
        on_asked: Callable[[dict[str, Any]], None] = lambda asked: None,
    ) -> None:
        """Start serving."""
        self._on_viewer, self._on_asked = on_viewer, on_asked
        self._gate = Gate()
        self._latest: dict[tuple[str, str], str | bytes] = {}
        self._browsers: list[_Browser] = []
        self._loop = asyncio.new_event_loop()
        self._ending = asyncio.Event()
        self._problem: OSError | None = None
        self.port = port
        ready = Event()
        self._thread = Thread(target=self._run, args=(ready,), name="page", daemon=True)
        self._thread.start()
        ready.wait()
        if self._problem:
            self._thread.join()
            reason = os.strerror(self._problem.errno) if self._problem.errno else self._problem
            raise InputError(f"--web-port {port}: cannot listen there: {reason}; give another --web-port")
        self._page = make_page(self.port, self._gate.token).encode()

    @property
    def address(self) -> str:
        """The address to open in a browser; knowing it is all that is needed to look."""
        return f"http://127.0.0.1:{self.port}/?token={self._gate.token}"

    def picture(self, prefix: str, name: str, t_us: int, picture: NDArray[np.uint8]) -> None:
        """Show a picture, `(height, width)` uint8."""
        height, width = picture.shape
        about = {"camera": prefix, "channel": name, "width": width, "height": height}
        header = json.dumps(about).encode()
        self._put((prefix, name), struct.pack("<H", len(header)) + header + picture.tobytes())

    def record(self, prefix: str, name: str, t_us: int, record: dict[str, Any]) -> None:
        """Show JSON values."""
        self._put((prefix, name), json.dumps({"camera": prefix, "channel": name, "record": record}))

    def forget(self, prefix: str) -> None:
        """Keep nothing of a camera for browsers that come later."""
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._drop, prefix)

    def close(self) -> None:
        """Stop serving; browsers are told."""
        if self._loop.is_running():
            self._loop.call_soon_threadsafe(self._ending.set)
        self._thread.join()

    def _put(self, key: tuple[str, str], message: str | bytes) -> None:
        try:
            self._loop.call_soon_threadsafe(self._show, key, message)
        except RuntimeError:
            return  # the loop has ended, and with it every viewer

    def _show(self, key: tuple[str, str], message: str | bytes) -> None:
        if key not in self._latest:
            cameras = list(dict.fromkeys(camera for camera, _ in self._latest))
            if key[0] not in cameras and len(cameras) >= _MAX_CAMERAS:
                self._drop(cameras[0])
        self._latest[key] = message
        for browser in self._browsers:
            browser.show(key)

    def _drop(self, camera: str) -> None:
        for old in [old for old in self._latest if old[0] == camera]:
            del self._latest[old]

    def _run(self, ready: Event) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve(ready))
        finally:
            self._loop.close()
            ready.set()

    async def _serve(self, ready: Event) -> None:
        try:
            server = await serve(
                self._talk,
                "127.0.0.1",
                self.port,
                process_request=self._judge,
                max_size=_MAX_ASKED_BYTES,
                max_queue=4,
                compression=None,  # pictures would cost more than loopback carries in that time
                server_header=None,
            )
        except OSError as error:
            self._problem = error
            return
        self.port = server.sockets[0].getsockname()[1]
        ready.set()
        async with server:
            await self._ending.wait()

    def _judge(self, connection: ServerConnection, request: Request) -> Response | None:
        """Give the page, refuse, or let a browser talk."""
        address = urlsplit(request.path)
        if refusal := self._gate.refusal(request, self.port):
            return connection.respond(403, refusal)
        if address.path == "/stream":
            if len(self._browsers) >= MAX_CLIENTS:
                return connection.respond(503, "Too many browsers look already.\n")
            return None
        if address.path != "/":
            return connection.respond(404, "There is one page only.\n")
        headers = Headers(
            {
                "Content-Type": "text/html; charset=utf-8",
                "Content-Length": str(len(self._page)),
                "Cache-Control": "no-store",
                "Referrer-Policy": "no-referrer",
                "Connection": "close",
            }
        )
        return Response(200, "OK", headers, self._page)

    async def _talk(self, connection: ServerConnection) -> None:
        browser = _Browser(self._latest)
        self._browsers.append(browser)
        self._on_viewer()
        sending = asyncio.create_task(browser.send(connection))
        try:
            async for text in connection:
                asked = _read(text)
                if asked is not None:
                    self._on_asked(asked)
        except ConnectionClosed:
            pass
        finally:
            sending.cancel()
            self._browsers.remove(browser)


class _Browser:
    """What one browser has still to be shown: of each thing the latest only."""

    def __init__(self, latest: dict[tuple[str, str], str | bytes]) -> None:
        self._latest = latest
        self._waiting: dict[tuple[str, str], None] = dict.fromkeys(latest)
        self._changed = asyncio.Event()
        self._changed.set()

    def show(self, key: tuple[str, str]) -> None:
        self._waiting[key] = None
        self._changed.set()

    async def send(self, connection: ServerConnection) -> None:
        try:
            while True:
                await self._changed.wait()
                self._changed.clear()
                while self._waiting:
                    key = next(iter(self._waiting))
                    del self._waiting[key]
                    if key in self._latest:
                        await connection.send(self._latest[key])
        except ConnectionClosed:
            return


def _read(text: str | bytes) -> dict[str, Any] | None:
    """A browser's message; None if it is not one of this page."""
    try:
        asked = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return asked if isinstance(asked, dict) and isinstance(asked.get("op"), str) else None
