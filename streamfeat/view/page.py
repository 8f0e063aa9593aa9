"""The page: one file that shows a view in a browser.

Lives here: putting it together from its parts. Not here: serving it (`server`), what it shows (`sink`).

Everything is in the one file, and its content security policy lets it talk to its own server alone.
"""

from importlib.resources import files

__all__ = ["page"]


def page(port: int, token: str) -> str:
    """The page of the server at a port of this machine, which answers those who know the token."""
    parts = files("streamfeat.view") / "web"
    text = (parts / "page.html").read_text("utf-8")
    for mark, name in (
        ("/* style */", "style.css"),
        ("/* stream */", "stream.js"),
        ("/* plots */", "plots.js"),
        ("/* panels */", "panels.js"),
        ("/* player */", "player.js"),
        ("/* labels */", "labels.js"),
    ):
        text = text.replace(mark, (parts / name).read_text("utf-8"))
    return text.replace("STREAM_PORT", str(port)).replace("STREAM_TOKEN", token)
