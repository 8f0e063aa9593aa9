"""Channels that Foxglove, and the page, subscribe to: over a WebSocket server or in an MCAP file.

Lives here: names and schemas of the channels, the server, the file; all that needs foxglove-sdk.
Not here: what is sent (`sink`).

Pictures are `foxglove.RawImage` (mono8), everything else JSON with a schema. Log times are stream time.
"""

import json
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
from foxglove.channels import RawImageChannel
from foxglove.mcap import MCAPCompression, MCAPWriteOptions
from foxglove.messages import RawImage, Timestamp
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.stream.cameras import MAX_CAMERAS
from streamfeat.view.gate import FOXGLOVE_ORIGINS, Gate, GuardedPort, hidden_host

__all__ = ["Board", "FileBoard", "LiveBoard"]

_BACKLOG = 64
"""Messages that wait for a slow client, about ten looks of six channels; then the oldest are dropped."""

_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}
_NUMBERS = {"type": "array", "items": _NUMBER}


def _object(title: str, **properties: Any) -> dict[str, Any]:
    return {"type": "object", "title": title, "properties": properties}


SCHEMAS = {
    "features": _object(
        "streamfeat.Features",
        t_s=_NUMBER,
        filters_per_column=_NUMBER,
        cells={"type": "array", "items": _object("cell", positive=_NUMBERS, negative=_NUMBERS)},
    ),
    "prediction": _object(
        "streamfeat.Prediction",
        t_s=_NUMBER,
        label=_TEXT,
        scores=_NUMBERS,
        margin=_NUMBER,
        sample={"type": ["object", "null"]},
        samples=_NUMBER,
        right=_NUMBER,
    ),
    "engine": _object(
        "streamfeat.Engine",
        t_s=_NUMBER,
        active_volumes=_NUMBER,
        volumes=_NUMBER,
        update_us=_object("update", median=_NUMBER, max=_NUMBER, n=_NUMBER),
    ),
    "status": _object(
        "streamfeat.Status",
        t_s=_NUMBER,
        frame=_NUMBER,
        camera=_TEXT,
        events=_NUMBER,
        events_per_s=_NUMBER,
        drops={"type": "object", "additionalProperties": _NUMBER},
    ),
}


class Board:
    """The channels of all cameras.

    Args:
        about: said of every `status` channel in its metadata.
    """

    def __init__(self, about: Mapping[str, str]) -> None:
        """No channel before there is something to say."""
        # It calls each client that leaves without a word an error. Only the first call counts.
        foxglove.set_log_level("CRITICAL")
        self._context = foxglove.Context()
        self._about = dict(about)
        self._channels: dict[str, dict[str, RawImageChannel | foxglove.Channel]] = {}
        self._last: dict[str, Callable[[], None]] = {}

    def announce(self, prefix: str) -> None:
        """Open all channels of a camera, before there is something to show."""
        for name in ("events", "bins", "volumes", *SCHEMAS):
            self._channel(prefix, name)

    def picture(self, prefix: str, name: str, t_us: int, picture: NDArray[np.uint8]) -> None:
        """Show a picture, `(height, width)` uint8."""
        height, width = picture.shape
        t_us = max(t_us, 0)
        image = RawImage(
            timestamp=Timestamp(sec=t_us // 1_000_000, nsec=t_us % 1_000_000 * 1000),
            frame_id=prefix,
            width=width,
            height=height,
            encoding="mono8",
            step=width,
            data=picture.tobytes(),
        )
        self._log(prefix, name, image, t_us)

    def record(self, prefix: str, name: str, t_us: int, record: dict[str, Any]) -> None:
        """Show JSON values."""
        self._log(prefix, name, json.dumps(record), max(t_us, 0))

    def forget(self, prefix: str) -> None:
        """Close the channels of a camera."""
        for channel in self._channels.pop(prefix, {}).values():
            self._last.pop(channel.topic(), None)
            channel.close()

    def close(self) -> None:
        """No more will be shown."""

    def _log(self, prefix: str, name: str, message: Any, t_us: int) -> None:
        channel = self._channel(prefix, name)
        self._last[channel.topic()] = lambda: channel.log(message, log_time=t_us * 1000)
        self._last[channel.topic()]()

    def _channel(self, prefix: str, name: str) -> RawImageChannel | foxglove.Channel:
        if prefix not in self._channels and len(self._channels) >= MAX_CAMERAS:
            self.forget(next(iter(self._channels)))
        of_camera = self._channels.setdefault(prefix, {})
        if name not in of_camera:
            topic = f"{prefix}/{name}"
            of_camera[name] = (
                foxglove.Channel(
                    topic,
                    schema=SCHEMAS[name],
                    context=self._context,
                    metadata=self._about if name == "status" else None,
                )
                if name in SCHEMAS
                else RawImageChannel(topic, context=self._context)
            )
        return of_camera[name]


class LiveBoard(Board):
    """Channels over a WebSocket server on this machine. A client that comes later gets what was last shown.

    Args:
        about: see `Board`.
        name: of the server.
        port: on 127.0.0.1; 0 for any that is free.
        on_viewer: called, in a thread of the server's, when a client subscribes.
        origins: of pages that may look.

    Raises:
        InputError: the port cannot be used.
    """

    def __init__(
        self,
        about: Mapping[str, str],
        name: str,
        port: int,
        on_viewer: Callable[[], None] = lambda: None,
        origins: Collection[str] = FOXGLOVE_ORIGINS,
    ) -> None:
        """Start the server."""
        super().__init__(about)
        self._on_viewer = on_viewer
        host = hidden_host()
        try:
            self._server = foxglove.start_server(
                name=name,
                host=host,
                port=0,
                context=self._context,
                server_listener=self,
                message_backlog_size=_BACKLOG,
            )
        except RuntimeError as error:
            reason = str(error).rpartition("port: ")[2]
            raise InputError(f"--foxglove: cannot listen on {host}: {reason}") from None
        try:
            self._guard = GuardedPort(Gate(origins), port, f"{host}:{self._server.port}")
        except BaseException:
            self._server.stop()
            raise

    @property
    def port(self) -> int:
        """Where it listens."""
        return self._guard.port

    @property
    def address(self) -> str:
        """What to connect to."""
        return self._guard.address

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """A client has subscribed: show what was shown last."""
        with suppress(KeyError):
            self._last[channel.topic]()
        self._on_viewer()

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """A client has unsubscribed."""

    def close(self) -> None:
        """Stop the server; clients are told."""
        self._guard.close()
        self._server.stop()


class FileBoard(Board):
    """Channels in an MCAP file.

    Args:
        about: see `Board`.
        path: written in place; the caller moves it when it is complete.
        name: where to, for errors.

    Raises:
        InputError: it cannot be written.
    """

    def __init__(self, about: Mapping[str, str], path: Path, name: Path | None = None) -> None:
        """Open the file."""
        super().__init__(about)
        self._name = name or path
        options = MCAPWriteOptions(compression=MCAPCompression.Lz4)
        try:
            self._file = foxglove.open_mcap(
                path, allow_overwrite=True, context=self._context, writer_options=options
            )
        except (OSError, RuntimeError) as error:
            raise InputError(f"{path}: cannot write there: {error}") from None

    def close(self) -> None:
        """Finish the file.

        Raises:
            InputError: this, or anything before it, could not be written; only now the library says so.
        """
        try:
            self._file.close()
        except (OSError, RuntimeError) as error:
            raise InputError(f"{self._name}: cannot be written: {error}; is there room?") from None
