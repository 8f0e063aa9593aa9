"""What a live job does, on a terminal: what each camera shows first, then how it goes, then what went wrong.

Lives here: laying out what is counted, for 40 columns or more.
Not here: counting (`health`), and when the table is drawn anew (`listen`).
"""

import time
from collections.abc import Callable

from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

from streamfeat.live.health import CameraFigures, Health
from streamfeat.stream.emission import Emission

__all__ = ["HealthTable"]

_CAMERAS = 8
"""Cameras that have a line of their own; a terminal has few lines."""
_WIDE, _WIDEST_NAME = 60, 24
_RATE_S = 0.5
_COLOURS = ("cyan", "magenta", "green", "yellow", "blue", "bright_red", "bright_cyan", "bright_magenta")
_WORDS = {
    "unheard_packets": "packets before this began",
    "foreign_packets": "packets of a second publisher",
    "publisher_restarts": "publishers that began anew",
}
_DAY_US = 86_400_000_000
_SHOWN_ANYWAY = ("events", "emissions", "packets")


class HealthTable:
    """Draws the figures of a job as they are at the moment; rich asks it again and again.

    Args:
        health: of the job.
        clock: seconds, monotonic.
    """

    def __init__(self, health: Health, clock: Callable[[], float] = time.monotonic) -> None:
        """Nothing is read yet."""
        self._health, self._clock = health, clock
        self._rates: dict[str, tuple[float, int, float]] = {}

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The cameras, totals and latency, and counters that are not zero."""
        yield self._cameras(wide=options.max_width >= _WIDE)
        yield self._totals()
        troubles = self._troubles()
        if troubles:
            yield troubles

    def _cameras(self, *, wide: bool) -> Table | Text:
        cameras = self._health.cameras()
        if not cameras:
            return Text("no camera yet", style="dim")
        table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim", pad_edge=False)
        table.add_column("shows", no_wrap=True, max_width=_WIDEST_NAME, overflow="ellipsis")
        table.add_column("by", justify="right", no_wrap=True)
        table.add_column("events/s", justify="right", no_wrap=True)
        if wide:
            table.add_column("at", justify="right", no_wrap=True)
        table.add_column("camera", overflow="fold")
        for camera in cameras[:_CAMERAS]:
            shows, by = _shown(camera.latest)
            at = [_since(camera.latest)] if wide else []
            table.add_row(shows, by, self._rate(camera), *at, camera.topic)
        if len(cameras) > _CAMERAS:
            table.add_row(f"and {len(cameras) - _CAMERAS} more")
        return table

    def _rate(self, camera: CameraFigures) -> str:
        now = self._clock()
        since, events, rate = self._rates.get(camera.topic, (now, camera.events, 0.0))
        if now - since >= _RATE_S:
            rate = (camera.events - events) / (now - since)
            since, events = now, camera.events
        self._rates[camera.topic] = since, events, rate
        return f"{rate:,.0f}"

    def _totals(self) -> Text:
        values = {name: value for name, value, _ in self._health.figures()}
        said = [f"{values[name]:,} {name}" for name in _SHOWN_ANYWAY]
        for name, shares in self._health.latencies():
            if shares:
                said.append(f"{name} " + ", ".join(f"{share} {1e3 * s:.2f} ms" for share, s in shares))
        said += [f"{n:,} {name.replace('_', ' ')} waiting" for name, n in self._health.depths() if n]
        return Text("; ".join(said), style="dim")

    def _troubles(self) -> Text | None:
        found = [(name, n) for name, n, _ in self._health.figures() if n and name not in _SHOWN_ANYWAY]
        found += sorted(self._health.reasons().items())
        said = ", ".join(f"{_WORDS.get(name, name.replace('_', ' '))} {n:,}" for name, n in found)
        return Text(said, style="yellow") if said else None


def _since(e: Emission | None) -> str:
    """Stream time, where the camera does not count from 1970."""
    return f"{e.t_us / 1e6:.2f} s" if e and e.t_us < _DAY_US else ""


def _shown(e: Emission | None) -> tuple[Text, str]:
    """What an emission is taken for, in the colour of its class, and by how much; else its active volumes."""
    if e is None:
        return Text("-"), ""
    if e.prediction is None:
        active = "features" if e.active_volumes is None else f"{e.active_volumes:,} active volumes"
        return Text(active), ""
    best = e.labels.index(e.prediction)
    scores = sorted(e.scores.tolist())
    margin = f"{scores[-1] - scores[-2]:+.2f}" if len(scores) > 1 else ""
    return Text(e.prediction, style=f"bold {_COLOURS[best % len(_COLOURS)]}"), margin
