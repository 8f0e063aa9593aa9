"""Messages that are refused for what they hold.

Lives here: the limits of names, payloads and labels, and the reasons that are counted.
Not here: refusals for want of room (`intake`).
"""

from streamfeat.errors import InputError
from streamfeat.live.inbox import RawMessage
from streamfeat.messages.event_messages import parse_events
from streamfeat.messages.packets import MAX_LABEL_US, Content, Label

__all__ = ["MAX_NAME", "MAX_PAYLOAD_BYTES", "RefusalError", "checked_label", "parsed", "problem_of"]

MAX_PAYLOAD_BYTES = 4 << 20
MAX_NAME = 1024
"""Characters of the name of a topic."""


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


_PROBLEMS = {
    "too large": f"at most {MAX_PAYLOAD_BYTES} bytes are read",
    "wildcard key": "a message is of one topic; publish it on the key of that",
    "bad name": f"the name of a topic has 1 to {MAX_NAME} characters",
}


def problem_of(key: str, topic: str, size: int) -> str:
    """The reason to refuse a message before its bytes are looked at, or ''.

    Args:
        key: that it was put on.
        topic: the name of that key, as it is shown.
        size: bytes of its payload.
    """
    if "*" in key:
        return "wildcard key"
    if not topic.strip("/") or len(topic) > MAX_NAME:
        return "bad name"
    return "too large" if size > MAX_PAYLOAD_BYTES else ""


_NO_REFUSAL = RefusalError("", "")


def parsed(message: RawMessage) -> tuple[Content | None, RefusalError]:
    """A message of events taken apart, or None and why it cannot be used."""
    if message.problem:
        return None, RefusalError(message.problem, _PROBLEMS[message.problem])
    try:
        return parse_events(message.schema, message.payload), _NO_REFUSAL
    except InputError as error:
        return None, RefusalError("bad packet", str(error))


def checked_label(message: RawMessage) -> Label:
    """The label that a message holds.

    Raises:
        RefusalError: the bytes are no such message, or it is too long in time or text.
    """
    if message.problem:
        raise RefusalError(message.problem, _PROBLEMS[message.problem])
    try:
        label = Label.from_cdr(message.payload)
    except InputError as error:
        raise RefusalError("bad label", str(error)) from None
    if label.duration_us > MAX_LABEL_US:
        raise RefusalError("bad label", f"{label.label[:40]!r} lasts {label.duration_us} us")
    return label
