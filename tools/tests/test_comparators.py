"""The table of all methods, from a result that was made up."""

import json

import tiny

from tools.bench.comparators import _walker, main, table

SETTING = {"patch": 3, "bins": 2, "filters": 4, "volumes": 100, "iterations": 1, "window_ms": 80.0}


def row(method, setting=None, swept=""):
    return {
        "method": method,
        "setting": setting or {},
        "swept": swept,
        "accuracy": 0.5,
        "low": 0.25,
        "high": 0.75,
        "features": 1_234,
        "encode_s": 0.06,
        "hits": "01",
    }


def test_each_method_of_a_result_has_a_row(tmp_path, capsys):
    recording = tiny.write_items(tmp_path / "animals.mcap", tiny.labelled_items(4, events=1_500))
    rows = [row("counts"), row("dart"), row("est"), row("dart", swept="mirror")]
    result = {"rows": rows, "samples": {"training": 3, "held_out": 1}}
    (tmp_path / "result.json").write_text(json.dumps(result))
    words = [str(recording), str(tmp_path / "result.json"), "--events", "2500", "--rounds", "2"]
    assert main([*words, "--json", str(tmp_path / "table.json")]) == 0
    found = json.loads((tmp_path / "table.json").read_bytes())["rows"]
    assert [one["method"] for one in found] == ["counts", "dart", "est"]
    for one in found[:2]:
        assert one["update"]["n"] == 2 * 2_500  # two packets a round, less what warms up
        assert 0 < one["update"]["p50_ns"] <= one["update"]["p99_ns"] <= one["update"]["max_ns"]
        assert one["events_per_s"] > 100
    said = capsys.readouterr().out
    assert "| `est` | 0.500 | 0.250 to 0.750 | - | - | - | - | 15.0 | 1,234 |" in said
    assert table(found) in said


def test_filters_are_learned_again_in_the_setting_of_the_result(tmp_path):
    items = tiny.labelled_items(4)
    recording = tiny.write_items(tmp_path / "animals.mcap", items)
    assert callable(_walker(recording, row("direct", SETTING), items))  # walking is test_latency's matter
    assert _walker(recording, row("est"), items) is None


def test_a_result_that_is_none_is_one_line(tmp_path, capsys):
    (tmp_path / "none.json").write_text("{}")
    assert main([str(tmp_path / "none.mcap"), str(tmp_path / "none.json")]) == 2
    assert capsys.readouterr().err.startswith("error: ")
