"""Tables and bars in terminals of any width: no value is cut, no bar is crowded out."""

import io
import re

import pytest
from rich.console import Console

from streamfeat.cli import progress
from streamfeat.cli.tables import print_table

HEADER = ["method", "K", "accuracy", "95 %\ninterval", "to the first"]
ROWS = [
    ["direct", "1,700", "0.901", "0.868-0.929", ""],
    ["kmeans", "400", "0.884", "0.847-0.918", "-0.017 (-0.027 to -0.007)"],
]


def printed(columns, rows=ROWS, **options):
    said = io.StringIO()
    print_table(Console(file=said, width=columns), "accuracy of all methods", HEADER, rows, **options)
    return [line.rstrip() for line in said.getvalue().splitlines()]


def test_a_table_that_fits_is_one():
    assert printed(80) == [
        "accuracy of all methods",
        "                             95 %",
        "method     K accuracy    interval              to the first",
        "direct 1,700    0.901 0.868-0.929",
        "kmeans   400    0.884 0.847-0.918 -0.017 (-0.027 to -0.007)",
    ]


@pytest.mark.parametrize("columns", [60, 40, 34])
def test_a_table_that_is_too_wide_is_cut_between_columns(columns):
    lines = printed(columns)
    assert max(map(len, lines)) <= columns
    text = "\n".join(lines)
    assert "…" not in text
    for value in [value for row in ROWS for value in row if value] + ["accuracy", "interval", "to the first"]:
        assert value in text
    # Each part says which row is which.
    parts = [line.split() for line in lines[1:]]
    assert [part[0] for part in parts].count("kmeans") == [part[0] for part in parts].count("method")


def test_a_value_wider_than_the_terminal_is_folded_and_whole():
    lines = printed(20, [["direct", "1", "0.9", "x" * 30, ""]])
    assert sum(line.count("x") for line in lines) == 30
    assert max(map(len, lines)) <= 20


@pytest.mark.parametrize("columns", [60, 80, 120])
def test_a_long_remark_leaves_room_for_bars_counts_and_times(monkeypatch, columns):
    said = io.StringIO()
    console = Console(file=said, force_terminal=True, width=columns, height=20, color_system=None)
    monkeypatch.setattr(progress, "err", console)
    with progress.progress_bars(from_a_thread=False, below=console) as report:
        report("looking for near copies", 3, 10, "")
        report("encoding", 7, 10, "a_recording_with_a_long_name.mcap, 350 samples " * 3)
    last = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", said.getvalue()).splitlines()[-2:]
    near, encoding = (line.rstrip() for line in last)
    assert near.count("━") >= 3
    assert encoding.count("━") >= 7
    assert "3/10" in near
    assert "7/10" in encoding
    assert len(encoding) <= columns
    assert ("a_recording" in encoding) == (columns > 80)
