"""A stream as a picture in the terminal: events, two pixels to a character, beside what they are taken for.

Lives here: the picture that fades as new events come, and the sink that draws it with scores.
Not here: where the events come from (`demo`), and lines of text (`sinks`).
"""

import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from threading import Event

import numpy as np
from numpy.typing import NDArray
from rich.color import Color
from rich.console import Console, RenderableType
from rich.live import Live
from rich.style import Style
from rich.table import Table
from rich.text import Text

from streamfeat.events import Events, Resolution
from streamfeat.messages.packets import Label, Packet
from streamfeat.stream.emission import Emission
from streamfeat.stream.pacing import groups_of, stream_time

__all__ = ["EventPicture", "TerminalView", "draw_while"]

_ON, _OFF = np.array([255.0, 196.0, 60.0]), np.array([70.0, 150.0, 255.0])
_HALF_LIFE_US = 20_000.0
"""Stream time in which a pixel loses half its light: edges stay edges, however rarely they are drawn."""
_FAINTEST = 0.15
_WAITING = 256
"""Batches that may wait to be drawn; older ones would have faded anyway."""
_PICTURES_A_SECOND = 15.0
_NARROWEST, _PICTURE, _BAR = 60, 34, 16
"""Columns: of a terminal that has room for the view, of its picture and of its bars."""


class EventPicture:
    """Recent events of one sensor: ON warm, OFF blue, both fading.

    Args:
        resolution: `(height, width)` of the sensor.
        columns: characters at most; a wider sensor is drawn smaller.
    """

    def __init__(self, resolution: Resolution, columns: int = 34) -> None:
        """Start dark."""
        height, width = resolution
        self._step = max(1, -(-width // columns))
        rows = -(-height // self._step)
        shape = rows + rows % 2, -(-width // self._step)
        self._sign, self._since = np.zeros(shape), np.zeros(shape)
        self._waiting: deque[Events] = deque(maxlen=_WAITING)

    def add(self, events: Events) -> None:
        """Have a batch drawn next time; may be called from another thread than `draw`."""
        self._waiting.append(events)

    def draw(self, now_us: int) -> Text:
        """Draw all events so far, each the fainter the longer before `now_us` it was.

        A character is an upper and a lower pixel. Which of them is lit shows in its shape, so that a
        picture without colours is still one.
        """
        while self._waiting:
            events = self._waiting.popleft()
            y, x = events["y"] // self._step, events["x"] // self._step
            inside = (y < self._sign.shape[0]) & (x < self._sign.shape[1])
            at = y[inside], x[inside]
            self._sign[at] = np.where(events["p"][inside] > 0, 1.0, -1.0)
            self._since[at] = events["t"][inside]
        age = np.maximum(now_us - self._since, 0.0)
        light = self._sign * np.exp2(-age / _HALF_LIFE_US)
        return Text("\n").join(
            _line(upper, lower) for upper, lower in zip(light[::2], light[1::2], strict=True)
        )


def draw_while(
    goes_on: Callable[[], bool], console: Console, items: Iterable[Packet | Label], resolution: Resolution
) -> None:
    """Draw the events of a recording at their own pace, until they end or something else is done.

    Args:
        goes_on: asked before each picture.
        console: a terminal, see `TerminalView.fits`; the picture is gone at the end.
        items: of the recording.
        resolution: `(height, width)` of the sensor.
    """
    picture, pause = EventPicture(resolution, _PICTURE), Event()
    with Live(console=console, auto_refresh=False, transient=True) as live:
        due_us: int | None = None
        for group in groups_of(items, 1.0):
            now_us = stream_time(group.items)
            if now_us is None:
                continue
            for item in group.items:
                if isinstance(item, Packet):
                    picture.add(item.events)
            due_us = now_us if due_us is None else due_us
            while due_us <= now_us:
                if not goes_on():
                    return
                live.update(picture.draw(due_us), refresh=True)
                due_us += round(1e6 / _PICTURES_A_SECOND)
                pause.wait(1 / _PICTURES_A_SECOND)


def _line(upper: NDArray[np.float64], lower: NDArray[np.float64]) -> Text:
    line = Text(no_wrap=True)
    for above, below in zip(upper.tolist(), lower.tolist(), strict=True):
        if abs(above) < _FAINTEST and abs(below) < _FAINTEST:
            line.append(" ")
        elif abs(below) < _FAINTEST:
            line.append("▀", Style(color=_colour(above)))
        elif abs(above) < _FAINTEST:
            line.append("▄", Style(color=_colour(below)))
        elif above * below > 0:
            line.append("█", Style(color=_colour(above)))
        else:
            line.append("▀", Style(color=_colour(above), bgcolor=_colour(below)))
    return line


def _colour(light: float) -> Color:
    red, green, blue = (_ON if light > 0 else _OFF) * abs(light)
    return Color.from_rgb(red, green, blue)


class TerminalView:
    """A sink that keeps one picture up to date: recent events, scores, and how many samples were right.

    Args:
        console: a terminal, see `fits`.
        resolution: `(height, width)` of the sensor.
        clock: seconds, monotonic.
    """

    def __init__(
        self, console: Console, resolution: Resolution, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Draw nothing yet."""
        self.picture = EventPicture(resolution, _PICTURE)
        self._live = Live(console=console, auto_refresh=False)
        self._live.start()
        self._clock = clock
        self._next = 0.0
        self._latest: Emission | None = None
        self._widest = 1e-9
        self._samples = 0
        self._correct = 0

    @staticmethod
    def fits(console: Console) -> bool:
        """Whether a console is a terminal with room and characters for the view."""
        can_draw = console.is_terminal and not console.is_dumb_terminal and console.encoding.startswith("utf")
        return can_draw and console.width >= _NARROWEST

    def write(self, emissions: Sequence[Emission]) -> None:
        """Count samples, and draw the latest emission where it is time to."""
        finals = [e for e in emissions if e.final]
        self._samples += len(finals)
        self._correct += sum(bool(e.correct) for e in finals)
        self._latest = emissions[-1]
        if self._clock() >= self._next:
            self._draw(self._latest)
            self._next = self._clock() + 1 / _PICTURES_A_SECOND

    def close(self, *, failed: bool) -> None:
        """Leave the last picture where it is."""
        if self._latest:
            self._draw(self._latest)
        self._live.stop()

    def _draw(self, e: Emission) -> None:
        side = Table.grid()
        side.add_row(Text(f"{e.t_us / 1e6:.1f} s, {e.n_events:,} events", style="dim"))
        side.add_row(self._bars(e) if e.labels else "")
        shown = f"this is a {e.sample.label}" if e.sample else ""
        side.add_row(Text(shown))
        if self._samples:
            share = f"{100 * self._correct / self._samples:.0f} % of {self._samples} right"
            side.add_row(Text(share, style="dim"))
        grid = Table.grid(padding=(0, 2))
        grid.add_column(width=_PICTURE)
        grid.add_column()
        grid.add_row(self.picture.draw(e.t_us), side)
        self._live.update(grid, refresh=True)

    def _bars(self, e: Emission) -> RenderableType:
        """A bar for each label, as long as its score is above the lowest; the prediction is bold.

        One scale for all that was drawn: the widest spread of scores so far fills a bar.
        """
        table = Table.grid(padding=(0, 1))
        scores = e.scores - e.scores.min()
        self._widest = max(self._widest, float(scores.max()))
        right = {True: "green", False: "red", None: "cyan"}[e.correct]
        for label, score in zip(e.labels, scores.tolist(), strict=True):
            is_first = label == e.prediction
            bar = Text("━" * round(_BAR * score / self._widest), style=right if is_first else "grey50")
            table.add_row(Text(label, style="bold" if is_first else "dim"), bar)
        return table
