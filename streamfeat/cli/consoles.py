"""Standard output and standard error of all commands.

Lives here: what makes text from outside harmless, and what becomes of an output that is closed or full.
Not here: what is printed.
"""

import errno
import os
from collections.abc import Iterator
from typing import Any

from rich.console import Console, ConsoleDimensions
from rich.segment import Segment
from rich.text import Text

from streamfeat.errors import printable_lines

__all__ = ["SafeConsole", "err", "out"]

_PIPE_COLUMNS = 1_000


class SafeConsole(Console):
    """A console that prints text from outside as text, and cuts nothing where it is no terminal.

    Names of files, topics and labels may hold escape sequences; here all that is printed passes, so that
    none does what it says. What reads a pipe or a file has room for long lines.
    """

    def print(self, *objects: Any, **options: Any) -> None:
        """Print; where nobody reads standard error, or it has no room, the command goes on in silence."""
        try:
            super().print(*objects, **options)
        except OSError:
            if not self.stderr:
                raise
            self.quiet = True

    def on_broken_pipe(self) -> None:
        """Raise what `print` and the program deal with."""
        raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))

    def render_str(self, text: str, **options: Any) -> Text:
        """Make text, perhaps with markup, of a string."""
        return super().render_str(printable_lines(text), **options)

    def render(self, renderable: Any, options: Any = None) -> Iterator[Segment]:
        """Make segments of anything."""
        for segment in super().render(renderable, options):
            is_safe = segment.control or segment.text.isprintable()
            yield segment if is_safe else Segment(printable_lines(segment.text), segment.style)

    @property  # type: ignore[misc]
    def size(self) -> ConsoleDimensions:
        """Columns and lines."""
        size = super().size
        cuts = self.is_terminal or "COLUMNS" in os.environ
        return size if cuts else ConsoleDimensions(_PIPE_COLUMNS, size.height)


out = SafeConsole(highlight=False, emoji=False)
err = SafeConsole(stderr=True, highlight=False, emoji=False)
