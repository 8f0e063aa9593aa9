"""A camera's clock, and what is wrong with it: restarts, jumps and timestamps that wrap.

Lives here: placing a packet's times on the stream's time.
Not here: decoding (24-bit times of `evt3` are unwrapped there), and the engine, which sees the placed times.
"""

from typing import Any, Literal, NamedTuple

from streamfeat.files.json_fields import Fields
from streamfeat.messages.packets import MAX_STREAM_US
from streamfeat.messages.strays import BACK_US, STEP_US

__all__ = ["CameraClock", "Placement"]

_WRAPS_US = (1 << 32, 1 << 31, 1 << 24)
"""Periods of camera clocks that are known to wrap: 32 bits (72 minutes), libcaer (36) and EVT3 (16.8 s)."""
_NEAR_US = 2_000_000
"""A fall that misses a period by less than this is a wrap."""
_JUMP_US = 60_000_000
"""More than this ahead, and more than twice the time that passed here, is a jump."""
_LATEST_US = 1 << 52
"""No snapshot holds a later time."""


class Placement(NamedTuple):
    """Where a packet belongs.

    Attributes:
        offset_us: added to its times.
        epoch: counts up when the clock starts anew; times of two epochs cannot be compared.
        event: what was recognised just now.
    """

    offset_us: int
    epoch: int
    event: Literal["", "wrapped", "restarted", "jumped"]


class CameraClock:
    """Follows the times of one camera's packets.

    A wrap is undone. A restart or a jump starts a new epoch: the window is emptied instead of being moved on
    bin by bin, and no packet waits for the old time to come back. A wrap that would lead beyond
    `MAX_STREAM_US` is a restart.

    Attributes:
        reached_us: stream time that the packets have reached; None before the first.
        offset_us: of the latest packet, see `Placement`.
        epoch: of the latest packet, see `Placement`.
    """

    __slots__ = ("_heard_ns", "epoch", "offset_us", "reached_us")

    def __init__(self) -> None:
        """No packet yet."""
        self.reached_us: int | None = None
        self.offset_us = self.epoch = 0
        self._heard_ns = 0

    def snapshot(self, now_ns: int) -> dict[str, Any]:
        """What is known of the camera's clock, as JSON values; times of ours as what has passed since."""
        return {
            "last_us": self.reached_us,
            "passed_ns": max(now_ns - self._heard_ns, 0),
            "offset_us": self.offset_us,
            "epoch": self.epoch,
        }

    def restore(self, values: Fields, now_ns: int) -> None:
        """Go on from a snapshot.

        Raises:
            InputError: the values are not those of a clock.
        """
        self.reached_us = values.maybe("last_us", 0, _LATEST_US)
        self._heard_ns = now_ns - values.whole("passed_ns")
        self.offset_us = values.whole("offset_us", 0, _LATEST_US)
        self.epoch = values.whole("epoch")

    def is_suspicious(self, first_us: int, now_ns: int) -> bool:
        """Whether a packet's times step so far that the next packet must show if the step is real.

        Args:
            first_us: time of its earliest event, as the camera says.
            now_ns: as of `place`.
        """
        if self.reached_us is None:
            return False
        step = first_us + self.offset_us - self.reached_us
        return step < -BACK_US or step > STEP_US + 2 * max(now_ns - self._heard_ns, 0) // 1000

    def goes_on(self, first_us: int, last_us: int, now_ns: int) -> bool:
        """Place a packet that goes on from the one before beyond doubt, in the least time, as nearly all do.

        Args:
            first_us: as of `place`.
            last_us: as of `place`; no later than `MAX_STREAM_US`.
            now_ns: as of `place`.

        Returns:
            False, and nothing has changed, where it is for `place` to decide.
        """
        reached_us = self.reached_us
        if reached_us is None or self.offset_us or not reached_us <= first_us <= reached_us + STEP_US:
            return False
        if last_us - first_us > STEP_US:
            return False
        self.reached_us, self._heard_ns = last_us, now_ns
        return True

    def place(self, first_us: int, last_us: int, now_ns: int, *, anew: bool = False) -> Placement:
        """Place the next packet.

        Args:
            first_us: time of its earliest event, as the camera says.
            last_us: time of its latest event.
            now_ns: when it arrived or was recorded, by a clock that does not go back.
            anew: its publisher counts anew, so that any fall is a restart.
        """
        event: Literal["", "wrapped", "restarted", "jumped"] = ""
        if self.reached_us is not None:
            step = first_us + self.offset_us - self.reached_us
            elapsed_us = max(now_ns - self._heard_ns, 0) // 1000
            room_us = MAX_STREAM_US - last_us - self.offset_us
            if step < (0 if anew else -BACK_US):
                periods = () if anew else _WRAPS_US
                period = next((w for w in periods if abs(step + w) <= _NEAR_US and w <= room_us), 0)
                event = "wrapped" if period else "restarted"
                self.offset_us += period
            elif room_us < 0 < self.offset_us:
                event = "restarted"
            elif step > _JUMP_US + 2 * elapsed_us:
                event = "jumped"
        if event in ("restarted", "jumped"):
            self.epoch += 1
            self.offset_us = 0
            self.reached_us = None
        placed = last_us + self.offset_us
        self.reached_us = placed if self.reached_us is None else max(self.reached_us, placed)
        self._heard_ns = now_ns
        return Placement(self.offset_us, self.epoch, event)
