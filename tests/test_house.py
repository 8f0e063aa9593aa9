"""The rules of the house, executable: what may import what, and what a module looks like."""

import ast
import functools
import importlib
import inspect
from pathlib import Path

import pytest

import streamfeat

PACKAGE = Path(streamfeat.__file__).parent

LAYERS = [
    {"errors", "events", "kernels.compiled", "kernels.layout"},
    {"places"},
    {
        "geometry",
        "files",
        "json_fields",
        "messages",
        "mcap_records",
        "svm",
        "simulate",
        "machine",
        "conventions",
        "workers",
    },
    {
        "kernels.code",
        "kernels.decode",
        "kernels.ingest",
        "kernels.lasso",
        "kernels.volume",
        "kernels.surfaces",
    },
    {"kernels.encode", "codecs", "safe_arrays"},
    {"kernels.planes", "packets"},
    {"kernels.change", "kernels.update"},
    {"kernels.follow"},
    {"operator", "state", "samples"},
    {"recording"},
    {"window", "recorder", "emission"},
    {"encoder", "sinks", "report", "table", "terminal_view"},
    {"cluster", "engine", "classifier", "features", "foreign", "learn"},
    {"errands", "moment"},
    {"session"},
    {"cameras", "pipeline"},
    {"replay", "live"},
    {"evaluate", "latency", "demo", "doctor", "view"},
    {"cli"},
]
"""A module may import from layers above its own line only; one that is new needs a place here."""

ROOMS = {
    "learn": [
        {"chunks", "omega", "setting", "volumes"},
        {"initial", "whitening"},
        {"alternation"},
        {"dictionary", "transform"},
        {"fit"},
    ],
    "foreign": [
        {"hdf5_process", "words"},
        {"aedat4", "tables"},
        {"containers"},
        {"event_files"},
        {"datasets"},
    ],
    "latency": [{"histogram", "stopwatch"}, {"hop", "update"}, {"measure"}, {"words"}, {"picture"}],
    "live": [
        {"clock", "delivery", "inbox", "names", "shard"},
        {"topic"},
        {"intake"},
        {"health", "network", "publisher"},
        {"keep", "screen"},
        {"listen", "publish", "record"},
        {"spread"},
    ],
    "evaluate": [
        {"plan", "published", "scores", "splits", "surfaces"},
        {"methods", "words"},
        {"cell", "page"},
        {"run"},
    ],
    "view": [{"channels", "layout", "observe", "page", "pictures"}, {"sink"}, {"job"}],
    "cli": [
        {"options", "program"},
        {"evaluating", "learning", "live", "measuring", "recordings", "starting", "streaming"},
        {"viewing"},
    ],
}
"""The same inside packages that are one place in the layers."""

ONLY_IN = {
    "asyncio": {"pipeline", "latency.hop"},
    "mcap": {"mcap_records", "recording", "recorder"},
    "zenoh": {"live.network", "live.publisher", "live.publish"},
    "prometheus_client": {"live.health"},
    "typer": {
        "cli.program",
        "cli.options",
        "cli.evaluating",
        "cli.recordings",
        "cli.learning",
        "cli.live",
        "cli.measuring",
        "cli.starting",
        "cli.streaming",
        "cli.viewing",
    },
    "hdrh": {"latency.histogram"},
    "fsspec": {"places"},
    "bokeh": {"report", "evaluate.page", "latency.picture"},
    "matplotlib": {"latency.picture"},
    "pyarrow": {"table"},
    "dask": {"cluster"},
    "distributed": {"cluster", "errands"},
    "foxglove": {"view.channels"},
    "numba": {"kernels.compiled", "kernels.lasso", "latency.stopwatch", "doctor"},
}

SYNCHRONOUS = {"asyncio", "time", "logging", "io", "threading", "datetime", "socket", "os", "pathlib", "sys"}
"""What the engine, the kernels and all that they stand on may not know."""

CLOCKLESS = {"asyncio", "time", "logging", "io", "threading"}

MODULES = sorted(path for path in PACKAGE.rglob("*.py"))


def name_of(path):
    """Dotted name below the package; a package is called as its folder, the whole one ''."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


NAMES = {name_of(path): path for path in MODULES}


@functools.cache
def tree_of(path):
    return ast.parse(path.read_text(encoding="utf-8"))


@functools.cache
def imports_of(path):
    """Every module that a file imports, also inside functions, as full dotted names."""
    found = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            # `from package import module` imports the module as well.
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            mine = {name for name in inner if name.removeprefix("streamfeat.") in NAMES}
            found |= mine or {node.module}
    return found


def own_imports(path):
    imported = imports_of(path)
    return {name.removeprefix("streamfeat.") for name in imported if name.startswith("streamfeat.")}


def place_of(name):
    """Line of a module in LAYERS; what is in a room has the place of the room."""
    for line, layer in enumerate(LAYERS):
        if name in layer or name.partition(".")[0] in layer:
            return line
    return None


def everything_below(name):
    """A module and all modules of the package that it imports, however far down."""
    found, waiting = set(), [name]
    while waiting:
        current = waiting.pop()
        if current not in found:
            found.add(current)
            waiting += own_imports(NAMES[current])
    return found


def modules(*, packages=False):
    names = [n for n in NAMES if packages or NAMES[n].name != "__init__.py"]
    return pytest.mark.parametrize("name", names)


def test_every_module_has_a_place_and_every_place_a_module():
    files = {n for n in NAMES if NAMES[n].name != "__init__.py"}
    assert [n for n in files if place_of(n) is None] == []
    placed = set().union(*LAYERS)
    assert [n for n in placed if n not in NAMES] == []
    assert sum(map(len, LAYERS)) == len(placed)
    for room, lines in ROOMS.items():
        assert {f"{room}.{n}" for line in lines for n in line} == {
            n for n in files if n.startswith(f"{room}.")
        }


@modules()
def test_imports_run_one_way(name):
    room, _, inner = name.partition(".")
    for imported in own_imports(NAMES[name]):
        if room in ROOMS and imported.startswith(f"{room}."):
            lines = ROOMS[room]
            mine, other = (
                next(i for i, line in enumerate(lines) if n in line)
                for n in (inner, imported.partition(".")[2])
            )
        else:
            mine, other = place_of(name), place_of(imported)
        assert other is not None, f"{name} imports {imported}, which has no place"
        assert other < mine, f"{name} may not import {imported}"


@pytest.mark.parametrize("library", ONLY_IN)
def test_a_library_is_imported_where_it_belongs(library):
    users = {n for n, path in NAMES.items() if library in {i.partition(".")[0] for i in imports_of(path)}}
    assert users <= ONLY_IN[library]


@pytest.mark.parametrize("name", sorted(n for n in NAMES if n.startswith("kernels.")))
def test_kernels_know_nothing_but_arrays(name):
    outside = {i.partition(".")[0] for i in imports_of(NAMES[name])} - {"streamfeat"}
    assert outside <= {"math", "numpy", "numba", "typing"}
    assert {i.partition(".")[0] for i in own_imports(NAMES[name])} <= {"kernels", "events"}


def test_the_engine_knows_no_clock_and_no_channel():
    assert not imports_of(NAMES["engine"]) & SYNCHRONOUS
    for name in ("engine", "session", "window", "state", "geometry", *everything_below("engine")):
        known = {i.partition(".")[0] for i in imports_of(NAMES[name])}
        assert not known & CLOCKLESS, f"{name} imports {sorted(known & CLOCKLESS)}"


@modules(packages=True)
def test_a_module_says_what_lives_in_it(name):
    charter = ast.get_docstring(tree_of(NAMES[name]))
    assert charter
    if name:  # the whole package is introduced by the README
        assert "Lives here" in charter
        assert "Not here" in charter


@modules(packages=True)
def test_a_module_is_short_and_well_named(name):
    assert len(NAMES[name].read_text(encoding="utf-8").splitlines()) <= 400
    assert not set(name.split(".")) & {"utils", "util", "helpers", "core", "common", "misc"}


@modules(packages=True)
def test_nothing_in_a_module_can_run_what_it_reads_or_reorder_floats(name):
    tree = tree_of(NAMES[name])
    forbidden = {"pickle", "cPickle", "dill", "joblib", "marshal", "shelve"}
    assert not {i.partition(".")[0] for i in imports_of(NAMES[name])} & forbidden
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            called = node.func.id if isinstance(node.func, ast.Name) else None
            assert called not in {"eval", "exec", "compile", "__import__"}, f"line {node.lineno}"
        if isinstance(node, ast.keyword):
            assert node.arg not in {"fastmath", "allow_pickle", "shell"} or (
                isinstance(node.value, ast.Constant) and node.value.value is False
            )


@pytest.mark.parametrize("name", sorted(n for n in NAMES if n.startswith("kernels.")))
def test_kernels_are_compiled_in_one_way(name):
    for node in ast.walk(tree_of(NAMES[name])):
        if isinstance(node, ast.FunctionDef):
            (decorator,) = node.decorator_list
            if isinstance(decorator, ast.Name):
                assert decorator.id in {"kernel", "inlined"}
            else:  # makes arrays, whose references must be counted
                options = {keyword.arg: keyword.value.value for keyword in decorator.keywords}
                assert options == {"cache": True, "nogil": True}


@modules(packages=True)
def test_what_a_module_offers_exists_and_is_described(name):
    module = importlib.import_module(f"streamfeat.{name}".rstrip("."))
    offered = getattr(module, "__all__", [])
    assert len(set(offered)) == len(offered)
    if NAMES[name].name != "__init__.py" and not name.startswith("kernels."):
        assert offered, "a module says what it offers in __all__"
    for item in offered:
        value = getattr(module, item)
        if inspect.isclass(value) or inspect.isfunction(value):
            assert inspect.getdoc(value), item


def test_the_package_offers_about_a_dozen_names():
    assert len(streamfeat.__all__) <= 16
