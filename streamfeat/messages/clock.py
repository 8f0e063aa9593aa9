"""A camera's clock, and what is wrong with it: restarts, jumps and timestamps that wrap.

Lives here: placing a packet's times on the stream's time.
Not here: decoding (24-bit times of `evt3` are unwrapped there), and the engine, which sees sound time only.
"""

from typing import Any, Literal, NamedTuple

from streamfeat.files.json_fields import Fields

__all__ = ["CameraClock", "Placement"]

_WRAPS_US = (1 << 32, 1 << 31, 1 << 24)
"""Periods of camera clocks that are known to wrap: 32 bits (72 minutes), libcaer (36) and EVT3 (16.8 s)."""
_NEAR_US = 2_000_000
"""A fall that misses a period by less than this is a wrap."""
_JUMP_US = 60_000_000
"""More than this ahead, and more than twice the time that passed here, is a jump."""
_BACK_US = 1_000_000
"""A fall of less than this, or than a window, is events out of order: late, perhaps, of the same clock."""
_LATEST_US = 1 << 52


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
    bin by bin, and no packet waits for the old time to come back.

    Args:
        window_us: length of the window; falls within it are events out of order.
        back_us: smaller falls are events out of order, however short the window is.
    """

    def __init__(self, window_us: int, back_us: int = _BACK_US) -> None:
        """No packet yet."""
        self._back_us = max(window_us, back_us)
        self._last_us: int | None = None
        self._heard_ns = 0
        self._offset_us = 0
        self._epoch = 0

    @property
    def epoch(self) -> int:
        """Of the latest packet, see `Placement`."""
        return self._epoch

    @property
    def offset_us(self) -> int:
        """Of the latest packet, see `Placement`."""
        return self._offset_us

    def snapshot(self, now_ns: int) -> dict[str, Any]:
        """What is known of the camera's clock, as JSON values; times of ours as what has passed since."""
        return {
            "last_us": self._last_us,
            "passed_ns": max(now_ns - self._heard_ns, 0),
            "offset_us": self._offset_us,
            "epoch": self._epoch,
        }

    def restore(self, values: Fields, now_ns: int) -> None:
        """Go on from a snapshot.

        Raises:
            InputError: the values are not a snapshot.
        """
        self._last_us = values.maybe("last_us", 0, _LATEST_US)
        self._heard_ns = now_ns - values.whole("passed_ns")
        self._offset_us = values.whole("offset_us", 0, _LATEST_US)
        self._epoch = values.whole("epoch")

    def place(self, first_us: int, last_us: int, now_ns: int, *, anew: bool = False) -> Placement:
        """Place the next packet.

        Args:
            first_us: time of its earliest event, as the camera says.
            last_us: time of its latest event.
            now_ns: when it arrived, by a clock that does not go back.
            anew: its publisher counts anew, so that any fall is a restart.
        """
        event: Literal["", "wrapped", "restarted", "jumped"] = ""
        if self._last_us is not None:
            step = first_us + self._offset_us - self._last_us
            elapsed_us = max(now_ns - self._heard_ns, 0) // 1000
            if step < (0 if anew else -self._back_us):
                period = next((w for w in _WRAPS_US if abs(step + w) <= _NEAR_US), 0) if not anew else 0
                event = "wrapped" if period else "restarted"
                self._offset_us += period
            elif step > _JUMP_US + 2 * elapsed_us:
                event = "jumped"
        if event in ("restarted", "jumped"):
            self._epoch += 1
            self._offset_us = 0
            self._last_us = None
        placed = last_us + self._offset_us
        self._last_us = placed if self._last_us is None else max(self._last_us, placed)
        self._heard_ns = now_ns
        return Placement(self._offset_us, self._epoch, event)
