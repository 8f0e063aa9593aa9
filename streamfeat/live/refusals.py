"""Messages that are refused for what they hold.

Lives here: the limits of a payload and of a label, and the reasons that are counted.
Not here: refusals for want of room (`intake`).
"""

from streamfeat.errors import InputError
from streamfeat.live.inbox import RawMessage
from streamfeat.messages.event_messages import parse_events
from streamfeat.messages.packets import MAX_LABEL_US, Content, Label

__all__ = ["MAX_PAYLOAD_BYTES", "RefusalError", "checked_label", "parsed"]

MAX_PAYLOAD_BYTES = 4 << 20
_LONGEST_TEXT = 4096
"""Characters of each text of a label."""


class RefusalError(Exception):
    """A message cannot be used.

    Args:
        reason: counted under it.
        detail: shown behind it.
    """

    def __init__(self, reason: str, detail: str) -> None:
        """Keep the reason beside the text."""
        super().__init__(detail)
        self.reason = reason


_NO_REFUSAL = RefusalError("", "")


def parsed(message: RawMessage) -> tuple[Content | None, RefusalError]:
    """A message of events taken apart, or None and why it cannot be used."""
    if message.problem:
        return None, RefusalError(message.problem, f"at most {MAX_PAYLOAD_BYTES} bytes are read")
    try:
        return parse_events(message.schema, message.payload), _NO_REFUSAL
    except InputError as error:
        return None, RefusalError("bad packet", str(error))


def checked_label(payload: bytes) -> Label:
    """The label that a message holds.

    Raises:
        RefusalError: the bytes are no such message, or it is too long in time or text.
    """
    try:
        label = Label.from_cdr(payload)
    except InputError as error:
        raise RefusalError("bad label", str(error)) from None
    if label.duration_us > MAX_LABEL_US:
        raise RefusalError("bad label", f"{label.label[:40]!r} lasts {label.duration_us} us")
    longest = max(len(text) for text in (label.label, label.split, label.source))
    if longest > _LONGEST_TEXT:
        raise RefusalError("bad label", f"a text of {longest} characters, at most {_LONGEST_TEXT}")
    return label
