"""Figures of a live job, as one table for people.

Lives here: laying out what is counted.
Not here: counting (`health`), and when the table is drawn anew (`listen`).
"""

from rich.console import Group
from rich.table import Table
from rich.text import Text

from streamfeat.live.health import Health

__all__ = ["HealthTable"]

_COLUMNS = 3
_CAMERAS = 8
"""Cameras that have a line of their own; a terminal has few lines."""


class HealthTable:
    """Draws the figures of a job's metrics as they are at the moment; rich asks it again and again.

    Args:
        health: of the job.
    """

    def __init__(self, health: Health) -> None:
        """Nothing is read yet."""
        self._health = health

    def __rich__(self) -> Group:
        """The cameras, all figures, and what was refused."""
        return Group(*(part for part in (self._cameras(), self._figures(), self._refused()) if part))

    def _cameras(self) -> Table | Text:
        cameras = self._health.cameras()
        if not cameras:
            return Text("no camera yet", style="dim")
        table = _grid("camera", "events", "emissions", "lost", "at", "prediction")
        for camera in cameras[:_CAMERAS]:
            seconds = "" if camera.t_us is None else f"{camera.t_us / 1e6:.2f} s"
            counts = (f"{n:,}" for n in (camera.events, camera.emissions, camera.lost))
            table.add_row(camera.topic, *counts, seconds, camera.prediction or "")
        if len(cameras) > _CAMERAS:
            table.add_row(f"and {len(cameras) - _CAMERAS} more")
        return table

    def _figures(self) -> Table:
        figures = [(name.replace("_", " "), f"{value:,}") for name, value, _ in self._health.figures()]
        figures += [(f"waiting: {name}".replace("_", " "), f"{n:,}") for name, n in self._health.depths()]
        for name, values in self._health.latencies():
            figures += [(f"{name} {share}", f"{seconds * 1e3:.2f} ms") for share, seconds in values]
        table = Table.grid(padding=(0, 2))
        for _ in range(_COLUMNS):
            table.add_column(style="dim")
            table.add_column(justify="right")
        rows = -(-len(figures) // _COLUMNS)
        for row in range(rows):
            table.add_row(*(cell for figure in figures[row::rows] for cell in figure))
        return table

    def _refused(self) -> Text | None:
        reasons = self._health.reasons()
        said = ", ".join(f"{reason} {count:,}" for reason, count in sorted(reasons.items()))
        return Text(said, style="yellow") if said else None


def _grid(first: str, *others: str) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold", pad_edge=False)
    table.add_column(first, style="cyan", overflow="ellipsis", no_wrap=True)
    for name in others:
        table.add_column(name, justify="right", no_wrap=True)
    return table
