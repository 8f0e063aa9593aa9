"""Values of an untrusted JSON object.

Lives here: taking them out one by one, with type and range checked.
Not here: what they mean.
"""

from collections.abc import Callable
from typing import TypeVar

from streamfeat.errors import InputError

__all__ = ["Fields"]

T = TypeVar("T")

_LARGEST = 1 << 62


class Fields:
    """A JSON object; each accessor refuses a value that is missing, of another type or out of range.

    Args:
        values: what was read.
        where: named in errors.
    """

    def __init__(self, values: object, where: str) -> None:
        """Check that it is an object."""
        if not isinstance(values, dict):
            raise InputError(f"{where}: not a JSON object")
        self._values = values
        self.where = where

    def __contains__(self, name: str) -> bool:
        """Whether there is a value that is not null."""
        return self._values.get(name) is not None

    def whole(self, name: str, least: int = 0, most: int = _LARGEST) -> int:
        """An integer of `[least, most]`."""
        return self._checked(name, int, lambda value: least <= value <= most)

    def maybe(self, name: str, least: int = 0, most: int = _LARGEST) -> int | None:
        """The same, or None where there is none."""
        return self.whole(name, least, most) if name in self else None

    def flag(self, name: str) -> bool:
        """True or false."""
        return self._checked(name, bool)

    def text(self, name: str, most: int = 1024) -> str:
        """A text of at most so many characters."""
        return self._checked(name, str, lambda value: len(value) <= most)

    def wholes(self, name: str, longest: int, least: int = 0, most: int = _LARGEST) -> list[int]:
        """A list of at most `longest` integers of `[least, most]`."""
        values = self._checked(name, list, lambda value: len(value) <= longest)
        return [Fields({name: value}, self.where).whole(name, least, most) for value in values]

    def inner(self, name: str) -> "Fields":
        """An object inside this one."""
        return Fields(self._values.get(name), f"{self.where}: {name}")

    def inners(self, name: str, most: int) -> list["Fields"]:
        """A list of at most `most` objects."""
        values = self._checked(name, list, lambda value: len(value) <= most)
        return [Fields(value, f"{self.where}: {name} {i}") for i, value in enumerate(values)]

    def _checked(self, name: str, kind: type[T], is_valid: Callable[[T], bool] = lambda value: True) -> T:
        value = self._values.get(name)
        # Not isinstance: true is no number here.
        if type(value) is not kind or not is_valid(value):
            raise InputError(f"{self.where}: {name} is {str(value)[:40]!r}, which is not possible")
        return value
