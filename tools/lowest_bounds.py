"""Print pip constraints that hold every dependency at the lowest version that `pyproject.toml` allows.

python tools/lowest_bounds.py > lowest.txt && pip install -e '.[test]' -c lowest.txt
"""

import tomllib
from itertools import chain
from pathlib import Path

from packaging.requirements import Requirement

PROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"


def lowest() -> dict[str, str]:
    """The lowest version of each dependency, the extras' included.

    Raises:
        ValueError: a dependency has no lower bound, no upper bound, or two lower bounds.
    """
    project = tomllib.loads(PROJECT.read_text())["project"]
    versions: dict[str, str] = {}
    for line in chain(project["dependencies"], *project["optional-dependencies"].values()):
        asked = Requirement(line)
        bounds = {bound.operator: bound.version for bound in asked.specifier}
        if bounds.keys() != {">=", "<"} or versions.setdefault(asked.name, bounds[">="]) != bounds[">="]:
            raise ValueError(f"{line}: one lower and one upper bound, the same wherever it is named")
    return versions


if __name__ == "__main__":
    for name, version in lowest().items():
        print(f"{name}=={version}")
