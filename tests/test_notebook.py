"""The notebook runs from its first cell to its last, and pictures are those of the events and filters."""

import ast
import asyncio
import inspect
import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import tiny

import streamfeat as sf

NOTEBOOK = Path(__file__).resolve().parents[1] / "tools" / "examples" / "first_steps.ipynb"


def pixels_of(png):
    """What is in a PNG of unfiltered rows: `(h, w, 4)`."""
    width, height, depth, kind = struct.unpack(">IIBB", png[16:26])
    assert (png[:8], depth, kind) == (b"\x89PNG\r\n\x1a\n", 8, 6)
    at = png.index(b"IDAT") + 4
    length = struct.unpack(">I", png[at - 8 : at - 4])[0]
    rows = np.frombuffer(zlib.decompress(png[at : at + length]), np.uint8).reshape(height, -1)
    assert not rows[:, 0].any()
    return rows[:, 1:].reshape(height, width, 4)


def test_the_notebook_runs_and_was_committed_without_outputs(monkeypatch):
    mpl = pytest.importorskip("matplotlib", reason="the extra `plot` is not installed")
    mpl.use("Agg")
    monkeypatch.chdir(NOTEBOOK.parent)
    cells = [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells)
    names, shown = {"__name__": "__main__"}, []

    async def run():
        for cell in cells:
            tree = ast.parse("".join(cell["source"]))
            last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
            flags = ast.PyCF_ALLOW_TOP_LEVEL_AWAIT
            found = eval(compile(tree, "cell", "exec", flags=flags), names)
            if inspect.iscoroutine(found):
                await found
            if last:
                shown.append(eval(compile(ast.Expression(last.value), "cell", "eval"), names))

    asyncio.run(run())
    drawings = [value for value in shown if hasattr(value, "_repr_png_")]
    assert len(drawings) == 2
    assert "samples right" in shown[-1]
    assert float(shown[-1].partition(" ")[0]) > 50


def test_each_pixel_shows_its_latest_event_the_older_the_fainter():
    events = sf.make_events(x=[3, 5, 3], y=[2, 2, 2], p=[1, 0, 0], t=[0, 0, 900])
    drawn = pixels_of(sf.draw(events, resolution=(8, 8))._repr_png_())[::40, ::40]
    lit = {(y, x): tuple(drawn[y, x].tolist()) for y, x in np.argwhere(drawn[..., 3]).tolist()}
    assert lit.keys() == {(2, 3), (2, 5)}
    assert lit[2, 3][:3] == lit[2, 5][:3] == (217, 72, 15)
    assert lit[2, 3][3] == 254 > lit[2, 5][3] > 0


def test_without_a_resolution_all_events_are_inside_and_none_are_fine():
    events = tiny.stream(range(300))
    height, width = int(events["y"].max()) + 1, int(events["x"].max()) + 1
    times = 320 // width
    assert sf.draw(events).pixels.shape == (height * times, width * times, 4)
    assert not sf.draw(events[:0]).pixels.any()
    with pytest.raises(sf.InputError, match="no pixels"):
        sf.draw(events, (0, 5))


def test_a_large_sensor_is_drawn_as_it_is_and_saved(tmp_path):
    drawing = sf.draw(tiny.stream(range(300), resolution=(260, 346)), (260, 346))
    assert drawing.pixels.shape == (260, 346, 4)
    drawing.save(tmp_path / "events.png")
    assert np.array_equal(pixels_of((tmp_path / "events.png").read_bytes()), drawing.pixels)
    with pytest.raises(sf.InputError, match="cannot write there"):
        drawing.save(tmp_path / "no" / "events.png")
    assert [path.name for path in tmp_path.iterdir()] == ["events.png"]


def test_filters_are_drawn():
    drawing = sf.draw(tiny.encoder(k=4))
    assert (drawing.pixels[..., 3] == 255).all()
    assert len(np.unique(drawing.pixels[..., 0])) > 10
