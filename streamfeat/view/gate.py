"""Who may look: the checks at each port of a view, and the proxy before a server that makes none.

Lives here: names, origins and tokens of a request; the bounded proxy that stands before Foxglove's server.
Not here: what is shown, and the servers behind (`server`, `channels`).

Any web page that is open in a browser can send requests to ports of this machine, and by a name that it binds
to 127.0.0.1 it can read the answers. So a request must name this machine, come from a page that is known, and
hold a token that is made anew for each view and stands in the address that is printed.

foxglove-sdk checks none of these. Its server listens on a port and, where the system has them, a loopback
address drawn by lot among 2^22, which no page finds; on the port that is asked for the proxy listens.
"""

import asyncio
import hmac
import os
import secrets
from collections.abc import Collection, Sequence
from contextlib import suppress
from threading import Event, Thread
from typing import Any
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.client import connect
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import InvalidHandshake, NegotiationError, WebSocketException
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from streamfeat.errors import InputError

__all__ = ["FOXGLOVE_ORIGINS", "MAX_CLIENTS", "Gate", "GuardedPort", "hidden_host"]

MAX_CLIENTS = 16
FOXGLOVE_ORIGINS = frozenset({"https://app.foxglove.dev", "https://studio.foxglove.dev", "file://"})
"""Of Foxglove's page and of its program; others have to be allowed."""

_FOXGLOVE = Subprotocol("foxglove.sdk.v1")
_MAX_ASKED_BYTES = 1 << 16


class Gate:
    """Judges requests; knows the token of one view.

    Args:
        origins: pages that may look, besides those of this port itself.

    Attributes:
        token: made anew.
    """

    def __init__(self, origins: Collection[str] = ()) -> None:
        """Draw a token."""
        self.token = secrets.token_urlsafe(16)
        self._origins = frozenset(origins)

    def refusal(self, request: Request, port: int) -> str:
        """Why a request may not pass; '' if it may."""
        names = {f"127.0.0.1:{port}", f"localhost:{port}"}
        origin = request.headers.get("Origin")
        token = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
        if request.headers.get_all("Host") not in [[name] for name in names]:
            return "This is no name of this server.\n"
        if origin is not None and origin not in self._origins and origin.removeprefix("http://") not in names:
            return "Pages of other origins may not look; `streamfeat view --origin` allows one.\n"
        if not hmac.compare_digest(token.encode(), self.token.encode()):
            return "Open the address that `streamfeat view` printed.\n"
        return ""


class GuardedPort:
    """A port of 127.0.0.1 that passes on what its gate lets through to a WebSocket server behind it.

    A client that is slow holds up nothing but itself: the server behind drops its oldest messages. One that
    does not say what it wants within ten seconds, or does not answer a ping for twenty, is hung up on.

    Args:
        gate: judges each request.
        port: to listen on; 0 for any that is free.
        behind: `HOST:PORT` of the server.

    Attributes:
        port: where it listens.

    Raises:
        InputError: the port cannot be used.
    """

    def __init__(self, gate: Gate, port: int, behind: str) -> None:
        """Start to listen."""
        self._gate, self._behind = gate, behind
        self._n_clients = 0
        self._loop = asyncio.new_event_loop()
        self._ending = asyncio.Event()
        self._problem: OSError | None = None
        self.port = port
        ready = Event()
        self._thread = Thread(target=self._run, args=(ready,), name="foxglove gate", daemon=True)
        self._thread.start()
        ready.wait()
        if self._problem:
            self._thread.join()
            reason = os.strerror(self._problem.errno) if self._problem.errno else self._problem
            raise InputError(f"--port {port}: cannot listen there: {reason}; give another --port")

    @property
    def address(self) -> str:
        """The address to connect to; knowing it is all that is needed."""
        return f"ws://127.0.0.1:{self.port}/?token={self._gate.token}"

    def close(self) -> None:
        """Stop listening, and hang up on all clients."""
        with suppress(RuntimeError):  # it has ended already
            self._loop.call_soon_threadsafe(self._ending.set)
        self._thread.join()

    def _run(self, ready: Event) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve(ready))
        finally:
            self._loop.close()
            ready.set()

    async def _serve(self, ready: Event) -> None:
        options: dict[str, Any] = {
            "process_request": self._judge,
            "select_subprotocol": _chosen,
            "max_size": _MAX_ASKED_BYTES,
            "max_queue": 4,
            "compression": None,
            "server_header": None,
        }
        try:
            server = await serve(self._talk, "127.0.0.1", self.port, **options)
        except OSError as error:
            self._problem = error
            return
        self.port = server.sockets[0].getsockname()[1]
        ready.set()
        async with server:
            await self._ending.wait()

    def _judge(self, connection: ServerConnection, request: Request) -> Response | None:
        if refusal := self._gate.refusal(request, self.port):
            return connection.respond(403, refusal)
        if self._n_clients >= MAX_CLIENTS:
            return connection.respond(503, "Too many clients look already.\n")
        return None

    async def _talk(self, client: ServerConnection) -> None:
        if self._n_clients >= MAX_CLIENTS:
            return
        self._n_clients += 1
        try:
            # Little is read ahead, so that the server sees a slow client as slow.
            async with connect(
                f"ws://{self._behind}",
                subprotocols=[_FOXGLOVE],
                compression=None,
                max_size=None,
                max_queue=2,
                proxy=None,
            ) as server:
                passing = [
                    asyncio.create_task(_pass_on(*ends)) for ends in ((client, server), (server, client))
                ]
                await asyncio.wait(passing, return_when=asyncio.FIRST_COMPLETED)
                for task in passing:
                    task.cancel()
                await asyncio.gather(*passing, return_exceptions=True)
        except (OSError, WebSocketException, InvalidHandshake):
            return  # the server behind has ended; the client is hung up on
        finally:
            self._n_clients -= 1


def hidden_host() -> str:
    """A loopback address that no page finds by trying; the common one where a system has no other."""
    import socket

    lot = secrets.randbits(22)
    host = f"127.{64 + (lot >> 16)}.{lot >> 8 & 255}.{lot & 255 or 1}"
    with socket.socket() as probe:
        try:
            probe.bind((host, 0))
        except OSError:
            return "127.0.0.1"
    return host


def _chosen(connection: ServerConnection, offered: Sequence[Subprotocol]) -> Subprotocol:
    if _FOXGLOVE not in offered:
        raise NegotiationError(f"this server speaks {_FOXGLOVE}")
    return _FOXGLOVE


async def _pass_on(source: Any, target: Any) -> None:
    with suppress(WebSocketException):
        async for message in source:
            await target.send(message)
