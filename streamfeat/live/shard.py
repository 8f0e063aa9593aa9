"""A fixed share of the cameras, for several processes that know nothing of each other.

Lives here: which of N shares a camera belongs to.
Not here: leaving other cameras out (`subscription`, `checkpoint`).

Every process works out the same shares from the names alone, so that processes need not agree on anything.
The cameras of a process that dies wait until that process is started again.
"""

from dataclasses import dataclass
from hashlib import blake2b
from typing import Self

from streamfeat.errors import InputError

__all__ = ["Shard"]


@dataclass(frozen=True, slots=True)
class Shard:
    """One of several shares.

    Attributes:
        index: which, counted from 0, as systemd instances and the pods of a StatefulSet are.
        of: how many there are.
    """

    index: int
    of: int

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read `I/N`.

        Raises:
            InputError: the text is something else, or there is no such share.
        """
        index, _, of = text.partition("/")
        # Digits alone: int() would take signs, spaces and underscores, and any length of them.
        if not all(part.isascii() and part.isdigit() and len(part) < 10 for part in (index, of)):
            raise InputError(f"--shard {text[:40]!r} is not understood; give I/N, such as 0/3, 1/3 and 2/3")
        shard = cls(int(index), int(of))
        if shard.index >= shard.of:
            raise InputError(f"--shard {text}: there is no such share; I counts from 0 to N - 1")
        return shard

    def has(self, topic: str) -> bool:
        """Whether a camera, or labels for it, belong to this share.

        The topic is a zenoh key or a ROS 2 topic as it is shown, without `/events` or `/label` at its end, so
        that labels go where their camera goes: BLAKE2b, 8 bytes of the UTF-8 text, read as a big-endian
        number, modulo N. This is a contract: another rule would move cameras between running processes.
        """
        parent, _, last = topic.rpartition("/")
        camera = parent if last in ("events", "label") else topic
        text = camera.encode(errors="surrogatepass")
        return int.from_bytes(blake2b(text, digest_size=8).digest(), "big") % self.of == self.index
