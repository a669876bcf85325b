"""The page at / : files without data of a dive, which their scripts ask for; none from elsewhere.

They are served without a token, so that a browser gets to the form that asks for it, and BlueOS
lists the extension.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import resources

KINDS = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
}
"""Content types by suffix."""

FOLDER = "/page/"
"""Where the files are."""
START = "index.html"
"""The one at / as well."""


@dataclass(frozen=True)
class PageFile:
    """A file as it is sent."""

    kind: str
    text: str


def page_file(path: str) -> PageFile | None:
    """The file at the path of an address; None if there is none."""
    if path == "/":
        path = FOLDER + START
    folder, _, name = path.rpartition("/")
    return _files().get(name) if f"{folder}/" == FOLDER else None


@cache
def _files() -> dict[str, PageFile]:
    """By name; read once, so that a request reads no path that a client wrote."""
    found = {}
    for entry in resources.files(__name__).iterdir():
        kind = KINDS.get(entry.name.rpartition(".")[2])
        if kind is not None:
            found[entry.name] = PageFile(kind, entry.read_text(encoding="utf-8"))
    return found
