"""How objects describe themselves in one line, and in a notebook.

Lives here: `Shown`, the base of what people print or leave at the end of a notebook's cell.
Not here: the descriptions (`notebook`), which are imported when one is asked for.
"""

__all__ = ["Shown"]


class Shown:
    """Has a short `repr`, and HTML for notebooks; see `notebook`."""

    __slots__ = ()

    def __repr__(self) -> str:
        """One line: the kind of object and its size."""
        from streamfeat.report.notebook import line_of

        return line_of(self)

    def _repr_html_(self) -> str:
        """A small table, with a picture where there is something to see."""
        from streamfeat.report.notebook import html_of

        return html_of(self)
