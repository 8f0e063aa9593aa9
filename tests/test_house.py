"""The rules of the house, executable: what may import what, and what a module looks like."""

import ast
import functools
import importlib
import inspect
import re
from pathlib import Path

import pytest

import streamfeat

PACKAGE = Path(streamfeat.__file__).parent

ALL_ABOVE = None

ROOMS = {
    "errors": set(),
    "events": {"errors"},
    "kernels": {"events"},
    "files": {"errors"},
    "work": {"errors"},
    "report": {"errors", "files"},
    "engine": {"errors", "events", "files", "kernels", "report"},
    "shipped": {"engine"},
    "messages": {"errors", "events", "files", "kernels"},
    "denoise": {"errors", "events", "kernels", "messages"},
    "simulate": {"errors", "events", "files", "kernels"},
    "camera_files": {"errors", "events", "files", "kernels", "messages"},
    "recordings": {"camera_files", "denoise", "errors", "events", "files", "messages", "report"},
    "classify": {
        "engine",
        "errors",
        "events",
        "files",
        "kernels",
        "messages",
        "recordings",
        "report",
        "work",
    },
    "learn": {"engine", "errors", "events", "files", "kernels", "messages", "recordings", "work"},
    "convert": {
        "camera_files",
        "classify",
        "denoise",
        "errors",
        "events",
        "files",
        "messages",
        "recordings",
        "simulate",
        "work",
    },
    "stream": {
        "classify",
        "denoise",
        "engine",
        "errors",
        "events",
        "files",
        "kernels",
        "messages",
        "recordings",
        "shipped",
        "work",
    },
    "evaluate": ALL_ABOVE,
    "latency": ALL_ABOVE,
    "live": ALL_ABOVE,
    "view": ALL_ABOVE,
    "demo": ALL_ABOVE,
    "cli": ALL_ABOVE,
}
"""Each room, and the rooms above it that it may import from."""

ONLY_IN = {
    "asyncio": {"stream", "latency", "view"},
    "mcap": {"recordings"},
    "zenoh": {"live"},
    "prometheus_client": {"live"},
    "typer": {"cli"},
    "hdrh": {"latency"},
    "fsspec": {"files"},
    "bokeh": {"report", "evaluate", "latency"},
    "matplotlib": {"latency"},
    "pyarrow": {"stream"},
    "dask": {"work"},
    "distributed": {"work"},
    "foxglove": {"view"},
    "websockets": {"view"},
    "PIL": {"simulate"},
    "av": {"simulate"},
    "torch": {"evaluate"},
    "numba": {"kernels", "latency", "cli"},
    "llvmlite": {"kernels", "cli"},
}
"""The rooms that may import a library."""

SYNCHRONOUS = {"asyncio", "time", "logging", "io", "threading", "datetime", "socket", "os", "pathlib", "sys"}
"""What the engine, the kernels and all that they stand on may not know."""

COMPILING = {"kernels.cache", "kernels.compiled", "kernels.assembly"}
"""Modules among the kernels that hold none: how they are compiled, and where machine code is kept."""

VECTOR_CODE = {"kernels.vectors", "kernels.lanes"}
"""Modules whose functions write machine code."""

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


def room_of(name):
    return name.partition(".")[0]


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


def test_every_module_is_in_a_room_and_few_are_at_the_root():
    assert {room_of(name) for name in NAMES} - {"", "__main__"} == set(ROOMS)
    assert len([path for path in MODULES if path.parent == PACKAGE]) <= 4


def test_rooms_stand_in_an_order_in_which_imports_run_one_way():
    order = list(ROOMS)
    for room, others in ROOMS.items():
        assert all(order.index(other) < order.index(room) for other in others or ()), room


@modules()
def test_imports_run_one_way_between_rooms(name):
    room, order = room_of(name), list(ROOMS)
    allowed = set(order) if room not in ROOMS else ROOMS[room]
    allowed = set(order[: order.index(room)]) if allowed is ALL_ABOVE else allowed
    for other in {room_of(imported) for imported in own_imports(NAMES[name])} - {room, ""}:
        assert other in allowed, f"{name} may not import from {other}"


@pytest.mark.parametrize("room", ROOMS)
def test_modules_of_a_room_import_each_other_without_circles(room):
    inside = {
        n: {i for i in own_imports(NAMES[n]) if room_of(i) == room} - {n} for n in NAMES if room_of(n) == room
    }
    while inside:
        free = [n for n, others in inside.items() if not others & set(inside)]
        assert free, f"a circle among {sorted(inside)}"
        for n in free:
            del inside[n]


@pytest.mark.parametrize("library", ONLY_IN)
def test_a_library_is_imported_where_it_belongs(library):
    users = {room_of(n) for n, path in NAMES.items() if library in {room_of(i) for i in imports_of(path)}}
    assert users <= ONLY_IN[library]


@pytest.mark.parametrize("name", sorted(n for n in NAMES if n.startswith("kernels.")))
def test_kernels_know_nothing_but_arrays(name):
    outside = {i.partition(".")[0] for i in imports_of(NAMES[name])} - {"streamfeat"}
    if name not in COMPILING:
        more = {"llvmlite"} if name in VECTOR_CODE else set()
        assert outside <= {"math", "numpy", "numba", "typing"} | more
    assert {i.partition(".")[0] for i in own_imports(NAMES[name])} <= {"kernels", "events"}


def test_the_engine_knows_no_clock_and_no_channel():
    assert not imports_of(NAMES["engine.engine"]) & SYNCHRONOUS
    for name in ("stream.session", *everything_below("engine.engine")):
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


@pytest.mark.parametrize(
    "name", sorted({n for n in NAMES if n.startswith("kernels.")} - COMPILING - VECTOR_CODE)
)
def test_kernels_are_compiled_in_one_way(name):
    for node in ast.walk(tree_of(NAMES[name])):
        if isinstance(node, ast.FunctionDef):
            (decorator,) = node.decorator_list
            assert decorator.id in {"kernel", "inlined", "spliced", "allocating"}


@pytest.mark.parametrize("name", sorted(VECTOR_CODE))
def test_vector_code_is_generated_in_one_way(name):
    """These modules offer functions that write machine code, and no others."""
    functions = [node for node in tree_of(NAMES[name]).body if isinstance(node, ast.FunctionDef)]
    generated = {f.name for f in functions if [ast.unparse(d) for d in f.decorator_list] == ["generated"]}
    assert generated == set(importlib.import_module(f"streamfeat.{name}").__all__)


@modules(packages=True)
def test_what_a_module_offers_exists_and_is_described(name):
    module = importlib.import_module(f"streamfeat.{name}".rstrip("."))
    offered = getattr(module, "__all__", [])
    assert len(set(offered)) == len(offered)
    if NAMES[name].name[:2] != "__" and not name.startswith("kernels."):
        assert offered, "a module says what it offers in __all__"
    for item in offered:
        value = getattr(module, item)
        if inspect.isclass(value) or inspect.isfunction(value):
            assert inspect.getdoc(value), item


def test_the_package_offers_about_twenty_names():
    assert len(streamfeat.__all__) <= 24
    assert set(streamfeat.__all__) == {*streamfeat._HOMES, "__version__"}
    assert set(dir(streamfeat)) >= set(streamfeat.__all__)


PAGES = [
    page
    for folder in (".", "recordings", "streamfeat", "tests", "tools")
    for page in PACKAGE.parent.glob(f"{folder}/**/*.md" if folder != "." else "*.md")
]


def test_links_of_pages_lead_to_files_and_headings():
    for page in PAGES:
        text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        for link in re.findall(r"\]\(\s*([^)\s]+)\s*\)", text):
            if link.startswith(("http:", "https:")):
                continue
            path, _, anchor = link.partition("#")
            target = (page.parent / path).resolve() if path else page
            assert target.exists(), f"{page}: {link}"
            if anchor:
                headings = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), re.MULTILINE)
                anchors = {re.sub(r"[^a-z0-9 _-]", "", h.lower()).replace(" ", "-") for h in headings}
                assert anchor in anchors, f"{page}: {link}"


def test_the_front_page_is_short():
    text = (PACKAGE.parent / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 300
    assert len(text.encode()) <= 20_000


def test_tests_import_no_tools():
    for path in (PACKAGE.parent / "tests").rglob("*.py"):
        for node in ast.walk(tree_of(path)):
            modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            modules += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            assert not any(name.split(".")[0] == "tools" for name in modules), path
