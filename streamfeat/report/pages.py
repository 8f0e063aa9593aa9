"""Reports: one page that can be sent by mail, opened without a network, and printed.

Lives here: the skeleton of such a page, with paragraphs, tables and interactive figures.
Not here: what a report says, or what its figures show.

Everything is in the one file, the drawing library included, once. It needs the extra `plot`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from streamfeat.errors import InputError
from streamfeat.files.atomic import write_atomically

if TYPE_CHECKING:
    from bokeh.plotting import figure

__all__ = ["Section", "Table", "require", "write_report"]


@dataclass(frozen=True, slots=True)
class Table:
    """A table of text; columns of numbers are best given with `numeric` true, which aligns them right."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    numeric: Sequence[bool] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """A heading and what stands under it, in order: paragraphs (text), tables, Bokeh figures."""

    title: str
    parts: Sequence["str | Table | figure"]


def require(library: str, *, extra: str = "plot", what: str = "a picture") -> None:
    """Check that a library of an extra is there, before work is done that would be lost.

    Args:
        library: as it is imported.
        extra: of this package, which brings it.
        what: the option or result that needs it, for the message.

    Raises:
        InputError: it is not installed.
    """
    from importlib.util import find_spec

    if find_spec(library) is None:
        raise InputError(f"{what} needs {library}, which is not there: pip install 'streamfeat[{extra}]'")


def write_report(path: Path, title: str, sections: Sequence[Section]) -> None:
    """Write a page; it appears whole or not at all, and replaces an earlier one.

    Args:
        path: HTML file.
        title: heading of the page.
        sections: what it says; text is shown as it is, markup in it has no effect.

    Raises:
        InputError: the extra `plot` is missing, or the folder cannot be written to.
    """
    require("bokeh")
    from bokeh.embed import components
    from bokeh.resources import Resources

    figures = [part for section in sections for part in section.parts if not isinstance(part, str | Table)]
    for each in figures:
        # As wide as the page, which may be a narrow one; buttons appear under the pointer, not in print.
        each.sizing_mode = "stretch_width"
        each.toolbar.logo, each.toolbar.autohide = None, True
    script, frames = components(figures) if figures else ("", ())
    waiting = iter(frames)
    body = []
    for section in sections:
        body.append(f"<h2>{escape(section.title)}</h2>")
        for part in section.parts:
            if isinstance(part, str):
                body.append(f"<p>{escape(part)}</p>")
            elif isinstance(part, Table):
                body.append(_table(part))
            else:
                body.append(f'<div class="figure">{next(waiting)}</div>')
    drawing = Resources(mode="inline", components=["bokeh"]).render_js() if figures else ""
    page = _PAGE.format(title=escape(title), body="\n".join(body), drawing=drawing, script=script)
    write_atomically(path, page.encode())


def _table(table: Table) -> str:
    numeric = [*table.numeric, *[False] * (len(table.header) - len(table.numeric))]

    def row(tag: str, cells: Sequence[str]) -> str:
        marks = [' class="number"' if number else "" for number in numeric]
        filled = (f"<{tag}{m}>{escape(c)}</{tag}>" for m, c in zip(marks, cells, strict=True))
        return f"<tr>{''.join(filled)}</tr>"

    rows = "\n".join(row("td", cells) for cells in table.rows)
    return f"<table><thead>{row('th', table.header)}</thead><tbody>\n{rows}\n</tbody></table>"


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; color: #222; background: #fff; max-width: 1100px;
  margin: 2rem auto; padding: 0 1rem; }}
h1 {{ font-size: 1.6rem; }}
h2 {{ font-size: 1.2rem; margin-top: 2rem; }}
h2, p:has(+ .figure), table:has(+ .figure) {{ break-after: avoid; }}
table {{ border-collapse: collapse; font-size: 13px; margin: 1rem 0; }}
th {{ text-align: left; border-bottom: 2px solid #888; }}
td {{ border-bottom: 1px solid #ddd; }}
th, td {{ padding: 0.2rem 0.6rem; white-space: nowrap; }}
.number {{ text-align: right; font-variant-numeric: tabular-nums; }}
.figure, table {{ break-inside: avoid; }}
@media print {{ body {{ max-width: none; margin: 0; font-size: 11px; }} table {{ font-size: 9px; }}
  th, td {{ padding: 0.1rem 0.3rem; }} }}
</style>
{drawing}
</head>
<body>
<h1>{title}</h1>
{body}
{script}
</body>
</html>
"""
