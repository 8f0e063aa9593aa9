"""Keeps numba from loading SciPy's linear algebra: a seventh of the time before a first prediction.

Lives here: the one import that is refused, to numba alone. Not here: kernels, none of which has a matrix
product.

numba asks once, when its first kernel is loaded, whether SciPy has a BLAS that `np.dot` could call in a
kernel (`numba.np.arraymath`), and for that imports all of `scipy.linalg`. Told that there is none, it goes
on. That is for a process of our own, the command; a program that calls this package may have such kernels.
"""

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

__all__ = ["spare_blas"]


class _NoBlas(MetaPathFinder):
    """Finds nothing; refuses `scipy.linalg` while numba asks for it."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        asking = sys.modules.get("numba.np.arraymath")
        if name == "scipy.linalg" and asking and not hasattr(asking, "_HAVE_BLAS"):
            raise ImportError("not needed in kernels")
        return None


def spare_blas() -> None:
    """Refuse numba's question, whenever it comes; all others get `scipy.linalg` as ever."""
    if not any(isinstance(finder, _NoBlas) for finder in sys.meta_path):
        sys.meta_path.insert(0, _NoBlas())
