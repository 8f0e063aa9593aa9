"""What was tried, and what came of it.

Lives here: one row for each kind of fault, and the table they make.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

__all__ = ["Part", "Row", "Trials", "markdown"]


@dataclass(frozen=True, slots=True)
class Row:
    """One kind of fault.

    Attributes:
        fault: what was done.
        tried: how often.
        survived: how often what is promised held; why it did not, otherwise, is in `failures`.
        lost_events: events that were lost, all told, each of them counted by the program; None where there
            are none to lose.
        lost_bytes: the same in bytes.
        recovery_s: median seconds until it worked again; None where there is nothing to recover.
        seconds: that all of it took.
        note: what else there is to say.
        failures: one line for each that did not survive.
    """

    fault: str
    tried: int
    survived: int
    lost_events: int | None = None
    lost_bytes: int | None = None
    recovery_s: float | None = None
    seconds: float = 0.0
    note: str = ""
    failures: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Trials:
    """What a part is given.

    Attributes:
        scale: 1 for the full number of trials; the short version has 0.01.
        seed: of everything random.
        folder: empty, to work in.
        say: told how far it is, a line at a time.
    """

    scale: float
    seed: int
    folder: Path
    say: Callable[[str], None]

    def times(self, full: int, least: int = 2) -> int:
        """How often to try what is tried so often in full."""
        return max(least, round(full * self.scale))


Part = Callable[[Trials], Sequence[Row]]


def markdown(rows: Sequence[Row]) -> str:
    """The table of `tests/torture/README.md`."""
    lines = [
        "| fault | tried | survived | lost events | lost bytes | recovery | took |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for row in rows:
        cells = [
            row.fault + (f" ({row.note})" if row.note else ""),
            f"{row.tried:,}",
            f"{row.survived:,}",
            _number(row.lost_events),
            _number(row.lost_bytes),
            "" if row.recovery_s is None else f"{row.recovery_s:.3g} s",
            f"{row.seconds:,.0f} s",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _number(value: int | None) -> str:
    return "" if value is None else f"{value:,}"
