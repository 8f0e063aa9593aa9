"""The page for those without Foxglove, and the server that hands it out.

Lives here: putting the page together from its parts, and serving that one file on loopback.
Not here: what it shows, which it gets from the same server as Foxglove (`channels`).

Everything is in the one file, and its content security policy lets it talk to that server alone.
"""

from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from socket import socket
from threading import Thread
from typing import Any

from streamfeat.errors import InputError

__all__ = ["PageServer", "page"]

_SLOW_S = 10.0


def page(stream_port: int) -> str:
    """The page that shows the stream of the server at a port of the machine it is opened on."""
    parts = files("streamfeat.view") / "web"
    text = (parts / "page.html").read_text("utf-8")
    for mark, name in (
        ("/* style */", "style.css"),
        ("/* stream */", "stream.js"),
        ("/* plots */", "plots.js"),
        ("/* panels */", "panels.js"),
    ):
        text = text.replace(mark, (parts / name).read_text("utf-8"))
    return text.replace("STREAM_PORT", str(stream_port))


class PageServer:
    """Serves one page on 127.0.0.1, in threads of its own.

    Args:
        text: the page.
        port: 0 for any that is free.

    Raises:
        InputError: the port cannot be used.
    """

    def __init__(self, text: str, port: int) -> None:
        """Start serving."""
        handler = type("Handler", (_Handler,), {"text": text.encode()})
        try:
            self._server = _Server(("127.0.0.1", port), handler)
        except OSError as error:
            raise InputError(
                f"--web-port {port}: cannot listen there: {error.strerror}; give another --web-port"
            ) from None
        self.port = int(self._server.server_port)
        self._thread = Thread(target=self._server.serve_forever, name="page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def handle_error(self, request: socket | tuple[bytes, socket], client_address: Any) -> None:
        """A browser that has gone is nobody's error."""


class _Handler(BaseHTTPRequestHandler):
    timeout = _SLOW_S
    text = b""

    def do_GET(self) -> None:
        """Give the page; there is nothing else."""
        if self.path.partition("?")[0] != "/":
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Length", str(len(self.text)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(self.text)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Say nothing."""
