"""Every compiled kernel against its slow twin, on random arguments, bit for bit."""

import ast
import importlib
import inspect
import pkgutil
import textwrap
from collections import Counter

import naive
import numpy as np
import pytest
from kernel_cases import CASES, STEPS, cases_of, reached
from kernel_table import KERNELS, Run, copied
from numba.core.errors import NumbaError
from numba.core.registry import CPUDispatcher

from streamfeat import kernels
from streamfeat.kernels import compiled
from streamfeat.kernels.lasso import duality_gap, solve_lasso_rows

ROUNDS, MOST_ROUNDS = 50, 400
"""Calls of a row: at least, and at most until each of its cases was reached."""

OFTEN = 3
"""Calls that must reach a case."""

NO_CASES: set[str] = set()
"""Kernels that branch, and whose rows name no case yet."""


def all_kernels():
    """Names of all compiled functions, each from the module it is defined in."""
    for info in pkgutil.iter_modules(kernels.__path__, kernels.__name__ + "."):
        module = importlib.import_module(info.name)
        for name, value in vars(module).items():
            if isinstance(value, CPUDispatcher) and value.py_func.__module__ == info.name:
                yield name


def run(function, arguments):
    after = tuple(copied(a) for a in arguments)
    return Run(arguments, after, function(*after))


@pytest.mark.parametrize("row", KERNELS, ids=lambda row: row.name)
def test_kernel_does_what_its_twin_does_in_every_case(row):
    missed, found, call = cases_of(row), Counter(), row.call
    for seed in range(MOST_ROUNDS):
        if seed >= ROUNDS and not missed:
            break
        arguments = row.make(np.random.default_rng([seed, 7]))
        kernel, twin = (run(function, arguments) for function in (call, row.twin))
        row.agree(kernel, twin)
        if missed:
            found.update(reached(row, twin))
            missed = {name for name in cases_of(row) if found[name] < OFTEN}
    assert not missed, f"{row.name}: no argument of its row is one of these cases: {sorted(missed)}"


def branches(kernel):
    """Whether a kernel takes one of two ways."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(kernel.py_func)))
    return any(isinstance(node, ast.If | ast.IfExp | ast.While) for node in ast.walk(tree))


def test_a_row_names_its_cases_where_its_kernel_branches():
    without = {row.name for row in KERNELS if branches(row.kernel) and not cases_of(row)}
    assert without == NO_CASES
    assert CASES.keys() | STEPS.keys() <= {row.name for row in KERNELS}


def test_every_kernel_has_a_row_and_a_twin():
    names = sorted(all_kernels())
    assert sorted(row.name for row in KERNELS) == names
    assert [name for name in names if not hasattr(naive, name)] == []


def test_no_kernel_on_the_way_of_an_event_can_allocate():
    on_the_way = [row.kernel for row in KERNELS if row.kernel is not solve_lasso_rows]
    assert all(kernel.targetoptions["_nrt"] is False for kernel in on_the_way)


def test_a_kernel_that_allocates_does_not_compile():
    with pytest.raises(NumbaError, match="NRT"):
        compiled.kernel(lambda n: np.zeros(n))(3)


def test_duality_gap_is_what_primal_and_dual_objective_differ_by():
    rng = np.random.default_rng(5)
    for _ in range(50):
        atoms, x, code = rng.normal(size=(6, 20)), rng.normal(size=20), rng.normal(size=6)
        rest = x - code @ atoms
        penalty = 0.3
        dual_point = rest * min(1, penalty / np.abs(atoms @ rest).max())
        primal = rest @ rest / 2 + penalty * np.abs(code).sum()
        dual = x @ x / 2 - (x - dual_point) @ (x - dual_point) / 2
        gap = duality_gap(atoms @ rest, atoms @ x, code, float(x @ x), penalty)
        assert gap == pytest.approx(primal - dual, rel=1e-9)
        assert gap >= 0
