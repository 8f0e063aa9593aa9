"""How much a file may become in memory, whatever it claims.

Lives here: `Budget`, the sum of what is unpacked from one file; its limit, and the option that raises it.
Not here: bounds of one packet or record, which formats have (`recordings.records`, `camera_files`).

Event data is packed to a tenth at best. A file that unpacks to far more was made to fill memory, or to keep a
reader busy: a few kilobytes of a common codec hold gigabytes of zeros. So everything that is unpacked from a
file is summed, and the sum may not exceed `FLOOR_BYTES` or `RATIO` times the file, whichever is larger.
"""

import os

from streamfeat.errors import InputError

__all__ = ["FLOOR_BYTES", "RATIO", "VARIABLE", "Budget", "parse_bytes"]

FLOOR_BYTES = 64 << 20
RATIO = 200
VARIABLE = "STREAMFEAT_UNPACK"
"""Environment variable with another floor, such as `4G`; `streamfeat --unpack 4G COMMAND` sets it."""

_UNITS = {"": 0, "K": 10, "M": 20, "G": 30}


class Budget:
    """What is left for one file, in one pass.

    Example:
        >>> budget = Budget(stored_bytes=1_000)
        >>> budget.take(50 << 20)
        >>> budget.take(50 << 20)
        Traceback (most recent call last):
        ...
        ValueError: it unpacks to more than 67108864 bytes; --unpack allows more

    Args:
        stored_bytes: size of the file.
    """

    def __init__(self, stored_bytes: int) -> None:
        """Nothing has been unpacked."""
        given = os.environ.get(VARIABLE, "")
        self._most = max(parse_bytes(given) if given else FLOOR_BYTES, RATIO * stored_bytes)
        self._used = 0

    @property
    def left(self) -> int:
        """Bytes that may still be unpacked."""
        return self._most - self._used

    def take(self, n_bytes: int) -> None:
        """Unpack so much more.

        Raises:
            ValueError: it is more than is left; nothing is taken.
        """
        if n_bytes > self.left:
            raise ValueError(f"it unpacks to more than {self._most} bytes; --unpack allows more")
        self._used += n_bytes


def parse_bytes(text: str, option: str = "--unpack") -> int:
    """Read a number of bytes such as `4G`, `500M` or `1000`, the value of an option.

    Raises:
        InputError: it is something else.
    """
    number, unit = text.strip().upper().removesuffix("B"), ""
    if number[-1:] in ("K", "M", "G"):
        number, unit = number[:-1], number[-1]
    if not (number.isascii() and number.isdecimal() and len(number) < 12):
        raise InputError(f"{option} {text}: give a number of bytes, such as 500M or 4G")
    return int(number) << _UNITS[unit]
