"""The error that a user can cause and mend.

Lives here: one exception, and what makes any text one line. The command line prints it as one line and exits
with status 2.
Not here: errors that only a bug can cause; those keep their traceback.
"""

__all__ = ["InputError", "printable", "printable_lines"]

_LONGEST = 1_000


class InputError(ValueError):
    """Something given to streamfeat cannot be used.

    The message is one line: what is wrong, where (file, topic, message, byte), and what to do. It may quote
    what is in a file or came over the network, so it is made `printable`.
    """

    def __init__(self, message: str) -> None:
        """Take the message; see `printable`."""
        super().__init__(printable(message))


def printable(text: str) -> str:
    """Text as one line that does nothing to a terminal: at most 1000 characters, white space as spaces, what
    cannot be shown escaped.
    """
    if not text.isprintable():
        text = printable_lines("".join(" " if c.isspace() else c for c in text[:_LONGEST]))
    return text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."


def printable_lines(text: str) -> str:
    """Text of any length that does nothing to a terminal but to begin new lines."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)
