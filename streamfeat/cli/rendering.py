"""A result as JSON has it, as people read it, and what the page of this room says of its fields.

Lives here: completing a result, and turning it into rows of text.
Not here: which fields there are (`results`), and how tables are drawn (`program`).
"""

from collections.abc import Mapping
from typing import Any

from streamfeat.cli.results import RESULTS, Field

__all__ = ["as_markdown", "complete", "for_people"]


def complete(command: str, result: Mapping[str, Any]) -> dict[str, Any]:
    """A result with every field of its command, in order; null, [] or {} for what is not there.

    Fields that the table lacks come last: tests hold commands to the table, users get what there is.
    """
    empty: dict[str, Any] = {"[": [], "{": {}}
    fields = RESULTS[command]
    known = {name: result.get(name, empty.get(field.kind[0])) for name, field in fields.items()}
    return known | {name: value for name, value in result.items() if name not in fields}


def for_people(result: Mapping[str, Any], fields: Mapping[str, Field]) -> list[tuple[str, str]]:
    """Names and values as people read them, without what is empty, and without zeros that say nothing."""
    rows = []
    for name, value in result.items():
        field = fields.get(name, Field("text", ""))
        if field.hidden or value is None or value in ([], {}, "") or (field.quiet and not value):
            continue
        rows.append((field.shown or name.replace("_", " "), _text(name, value)))
    return rows


def _text(name: str, value: Any) -> str:
    if name == "resolution":
        return f"{value[1]}x{value[0]}"
    if isinstance(value, Mapping) and "schema" in value:
        # A camera file has a format instead, and no messages.
        count = f", {value['messages']:,} messages" if value["messages"] or value["schema_encoding"] else ""
        return f"{value['name']} ({value['schema']}{count})"
    if isinstance(value, Mapping) and value.keys() == {"resolution", "packets"}:
        return f"{_text('resolution', value['resolution'])} ({value['packets']:,} packets)"
    if name == "other_resolutions" and len(value) > 3:
        return f"{_text(name, value[:3])} and {len(value) - 3} others"
    if name == "objective":
        return f"{value[0]:.6g} at first, {value[-1]:.6g} at last"
    if name == "empty_share":
        return f"{100 * value:.0f} %"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_text('', inner)}" for key, inner in value.items())
    if isinstance(value, list):
        return ", ".join(_text("", one) for one in value)
    return str(value)


def as_markdown() -> str:
    """All fields of all commands, as the page of this room shows them."""
    parts = []
    for command, fields in RESULTS.items():
        rows = "".join(f"| `{name}` | {field.kind} | {field.means} |\n" for name, field in fields.items())
        parts.append(f"### {command}\n\n| field | type | what |\n|---|---|---|\n{rows}")
    return "\n".join(parts)
