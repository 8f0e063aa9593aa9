"""The list of mutants is true: each text stands once, names are unique, and its tests are there."""

import shlex
from pathlib import Path

import pytest

from tools.mutate.__main__ import problem_of
from tools.mutate.mutants import MUTANTS
from tools.mutate.table import README, outcomes, page

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_a_mutant_is_found_and_changes_something(mutant):
    assert problem_of(mutant) is None
    assert mutant.old != mutant.new
    files = [word for word in shlex.split(mutant.tests) if word.startswith(("tests/", "tools/"))]
    assert files
    assert all((ROOT / file).exists() for file in files)


def test_names_are_unique_and_there_are_enough():
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS) >= 60


def test_nine_of_ten_that_were_tried_are_killed_and_each_survivor_has_its_reason():
    tried = outcomes()
    survivors = [mutant for mutant in MUTANTS if mutant.name in tried and tried[mutant.name][0] != "killed"]
    assert len(tried) >= 60
    assert len(survivors) <= len(tried) / 10
    assert [mutant.name for mutant in survivors if not mutant.why] == []


def test_the_page_has_the_table_of_the_results():
    assert README.read_text() == page(README.read_text())
