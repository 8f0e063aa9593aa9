"""Reports: one page that can be sent by mail, opened without a network, and printed.

Lives here: the skeleton of such a page, with paragraphs, tables and interactive figures, for light and dark.
Not here: what a report says, or what its figures show.

Everything is in the one file, the drawing library included, once. It needs the extra `plot`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from streamfeat.errors import InputError
from streamfeat.files.atomic import write_atomically

if TYPE_CHECKING:
    from bokeh.plotting import figure

__all__ = ["Folded", "Grid", "Section", "Table", "Wide", "require", "write_report"]

_INK = "#767e87"
"""Text of figures, legible on light and on dark."""
_GRID = "#88929c"


@dataclass(frozen=True, slots=True)
class Table:
    """A table of text; columns of numbers are best given with `numeric` true, which aligns them right."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    numeric: Sequence[bool] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Small figures beside each other, as many in a row as there is room for."""

    figures: Sequence["figure"]


@dataclass(frozen=True, slots=True, eq=False)
class Wide:
    """A figure that needs so many pixels; where the window has fewer, it is scrolled in its place."""

    figure: "figure"
    pixels: int


@dataclass(frozen=True, slots=True, eq=False)
class Folded:
    """What is shown when its summary is clicked, and in print."""

    summary: str
    parts: Sequence[Any]


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """A heading and what stands under it, in order: paragraphs (text), tables, figures, folded ones."""

    title: str
    parts: Sequence[Any]


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

    parts = [part for section in sections for part in section.parts]
    figures = list(_figures(parts))
    for each in figures:
        _dress(each)
    script, frames = components(figures) if figures else ("", ())
    waiting = iter(frames)
    body = [f"<h2>{escape(section.title)}</h2>\n{_html(section.parts, waiting)}" for section in sections]
    drawing = Resources(mode="inline", components=["bokeh"]).render_js() if figures else ""
    page = _PAGE.format(title=escape(title), body="\n".join(body), drawing=drawing, script=script)
    write_atomically(path, page.encode())


def _figures(parts: Sequence[Any]) -> Iterator[Any]:
    for part in parts:
        if isinstance(part, Folded):
            yield from _figures(part.parts)
        elif isinstance(part, Grid):
            yield from part.figures
        elif not isinstance(part, str | Table):
            yield part.figure if isinstance(part, Wide) else part


def _dress(plot: Any) -> None:
    """As wide as its place, in colours for light and dark; buttons are for a pointer, not for print."""
    plot.sizing_mode = "stretch_width"
    plot.toolbar.logo, plot.toolbar.autohide = None, True
    plot.background_fill_color = plot.border_fill_color = plot.outline_line_color = None
    plot.title.text_color = _INK
    for axis in plot.axis:
        axis.axis_label_text_color = axis.major_label_text_color = _INK
        axis.axis_line_color = axis.major_tick_line_color = axis.minor_tick_line_color = _GRID
    for grid in plot.grid:
        grid.grid_line_color, grid.grid_line_alpha = _GRID, 0.25
    for legend in plot.legend:
        legend.label_text_color = _INK
        legend.background_fill_color = legend.border_line_color = None


def _html(parts: Sequence[Any], waiting: Iterator[str]) -> str:
    shown = []
    for part in parts:
        if isinstance(part, str):
            shown.append(f"<p>{escape(part)}</p>")
        elif isinstance(part, Table):
            shown.append(_table(part))
        elif isinstance(part, Folded):
            inside = _html(part.parts, waiting)
            shown.append(f"<details><summary>{escape(part.summary)}</summary>\n{inside}\n</details>")
        elif isinstance(part, Grid):
            small = "".join(f'<div class="figure">{next(waiting)}</div>' for _ in part.figures)
            shown.append(f'<div class="grid">{small}</div>')
        elif isinstance(part, Wide):
            inside = f'<div style="min-width:{part.pixels}px">{next(waiting)}</div>'
            shown.append(f'<div class="scroll figure">{inside}</div>')
        else:
            shown.append(f'<div class="figure">{next(waiting)}</div>')
    return "\n".join(shown)


def _table(table: Table) -> str:
    numeric = [*table.numeric, *[False] * (len(table.header) - len(table.numeric))]

    def row(tag: str, cells: Sequence[str]) -> str:
        marks = [' class="number"' if number else "" for number in numeric]
        filled = (f"<{tag}{m}>{escape(c)}</{tag}>" for m, c in zip(marks, cells, strict=True))
        return f"<tr>{''.join(filled)}</tr>"

    rows = "\n".join(row("td", cells) for cells in table.rows)
    head = row("th", table.header)
    return f'<div class="scroll"><table><thead>{head}</thead><tbody>\n{rows}\n</tbody></table></div>'


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<meta name="color-scheme" content="light dark">
<style>
:root {{ --page: #fff; --text: #1c2128; --soft: #5b6470; --line: #d7dbe0; }}
@media screen and (prefers-color-scheme: dark) {{
  :root {{ --page: #12161c; --text: #e6e9ee; --soft: #9aa4b1; --line: #323a45; }}
}}
body {{ font: 15px/1.5 system-ui, sans-serif; color: var(--text); background: var(--page); max-width: 1100px;
  margin: 1.5rem auto; padding: 0 1rem; overflow-wrap: anywhere; }}
h1 {{ font-size: 1.6rem; line-height: 1.25; }}
h2 {{ font-size: 1.2rem; margin-top: 2rem; }}
h2, p:has(+ .figure), .scroll:has(+ .figure) {{ break-after: avoid; }}
h2 + p:first-of-type {{ margin-top: 0.4rem; }}
.scroll {{ overflow-x: auto; }}
.figure {{ min-width: 0; margin: 0.6rem 0; }}
.grid {{ display: grid; gap: 0 1rem;
  grid-template-columns: repeat(auto-fit, minmax(min(300px, 100%), 1fr)); }}
details {{ margin: 0.8rem 0; border-left: 2px solid var(--line); padding-left: 0.8rem; }}
summary {{ cursor: pointer; color: var(--soft); }}
table {{ border-collapse: collapse; font-size: 13px; margin: 0.8rem 0; }}
th {{ text-align: left; border-bottom: 2px solid var(--soft); }}
td {{ border-bottom: 1px solid var(--line); }}
th, td {{ padding: 0.2rem 0.6rem; white-space: nowrap; }}
.number {{ text-align: right; font-variant-numeric: tabular-nums; }}
.figure, table {{ break-inside: avoid; }}
@media print {{ body {{ max-width: none; margin: 0; font-size: 11px; }} table {{ font-size: 9px; }}
  .scroll {{ overflow: visible; }} details::details-content {{ content-visibility: visible; display: block; }}
  th, td {{ padding: 0.1rem 0.3rem; }} }}
</style>
{drawing}
</head>
<body>
<h1>{title}</h1>
{body}
{script}
<script>
addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((part) => {{
  part.open = true;
}}));
</script>
</body>
</html>
"""
