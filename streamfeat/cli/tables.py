"""Tables in a terminal of any width.

Lives here: a table that is cut into several, one below the other, where the terminal is too narrow for it.
Not here: what stands in tables (`streamfeat.evaluate.tables`, `streamfeat.latency.text`); tables of two
columns (`program.print_result`).
"""

from collections.abc import Iterator, Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

__all__ = ["print_table"]


def print_table(
    console: Console,
    title: str,
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    left: Sequence[int] = (0,),
    keys: int = 1,
) -> None:
    """Print a table whose values are never cut.

    Where it is too wide, as many columns as there is room for come first, and the others below them, each
    time beside the columns that tell one row from another. A single value that is wider than the terminal is
    folded.

    Args:
        console: where; a pipe has room for all.
        title: above it.
        header: of each column; may have several lines.
        rows: as many texts each as there are columns.
        left: columns that are aligned to the left; the others are numbers.
        keys: columns that tell one row from another, the first ones.
    """
    console.print(Text(title, style="table.title", overflow="fold"))
    widths = [_width([name, *(row[i] for row in rows)]) for i, name in enumerate(header)]
    for columns in _blocks(widths, keys, console.width):
        table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
        for i in columns:
            table.add_column(escape(header[i]), justify="left" if i in left else "right", overflow="fold")
        for row in rows:
            table.add_row(*(escape(row[i]) for i in columns))
        console.print(table)


def _blocks(widths: Sequence[int], keys: int, room: int) -> Iterator[list[int]]:
    """The columns of each part; a column that finds no room beside the keys stands there alone."""
    first = list(range(keys))
    block, used = first, sum(widths[i] + 1 for i in first)
    for i in range(keys, len(widths)):
        if used + widths[i] > room and len(block) > keys:
            yield block
            block, used = first, sum(widths[k] + 1 for k in first)
        block = [*block, i]
        used += widths[i] + 1
    yield block


def _width(texts: Sequence[str]) -> int:
    return max(len(line) for text in texts for line in text.split("\n"))
