"""Reports in a real browser: no wider than the window, light and dark, folded parts, many classes."""

import numpy as np
import pytest
from browser import Browser, find_chromium

pytest.importorskip("bokeh", reason="the extra `plot` is not installed")
pytestmark = [
    pytest.mark.real_time,
    pytest.mark.skipif(find_chromium() is None, reason="no chromium: apt-get install chromium"),
]


def confusion(n):
    rng = np.random.default_rng(n)
    return (np.eye(n, dtype=int) * 20 + rng.integers(0, 3, (n, n))).tolist()


@pytest.mark.parametrize("n", [10, 100])
def test_a_report_fits_its_window_in_light_and_dark(tmp_path, n):
    from streamfeat.evaluate.page import _accuracies, _confusions
    from streamfeat.report.pages import Folded, Section, Table, write_report

    names = [f"class {i}" for i in range(n)]
    rows = [
        {"method": method, "accuracy": 0.9, "low": 0.87, "high": 0.92, "confusion": confusion(n)}
        for method in ("direct", "counts")
    ]
    wide = Table([f"column {i}" for i in range(30)], [["value"] * 30])
    parts = [_accuracies(rows), wide, Folded("how", ["folded away"]), *_confusions(rows, names)]
    write_report(tmp_path / "page.html", "drive.mcap", [Section("Accuracy", parts)])
    with Browser() as tab:
        tab.open(f"file://{tmp_path}/page.html")
        tab.until("typeof Bokeh == 'object' && Bokeh.documents.length && Bokeh.documents[0].is_idle")
        for width, scheme in ((390, "light"), (480, "dark"), (1400, "light")):
            tab.resize(width, 900)
            tab.prefer(scheme)
            tab.until(f"innerWidth == {width} && matchMedia('(prefers-color-scheme: {scheme})').matches")
            tab.settle()
            assert tab.value("document.documentElement.scrollWidth <= innerWidth"), (width, scheme)
            page = tab.value("getComputedStyle(document.body).backgroundColor")
            assert page == {"light": "rgb(255, 255, 255)", "dark": "rgb(18, 22, 28)"}[scheme]
        assert not tab.value("document.querySelector('details').open")
        tab.value("dispatchEvent(new Event('beforeprint')); 0")
        assert tab.value("document.querySelector('details').open")
        assert tab.problems == []
    assert ("taken for" in (tmp_path / "page.html").read_text()) == (n == 100)
