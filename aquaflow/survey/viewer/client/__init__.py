"""The page's own files: compressed once, and asked for again only by whether they changed."""

from __future__ import annotations

import gzip
import hashlib
from dataclasses import dataclass
from functools import cache
from importlib import resources

from aquaflow.render import wgsl

KINDS = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "wgsl": "text/plain; charset=utf-8",
}
"""Content types by suffix."""
START = "index.html"
"""The one at / as well."""
SHARED = ("project", "sort", "sum")
"""The renderer's kernels that the page draws with (client/webgpu.js)."""


@dataclass(frozen=True)
class ClientFile:
    """A file as it is sent."""

    kind: str
    packed: bytes
    """Gzip."""
    tag: str
    """An ETag: the same for the same content."""


def client_file(path: str) -> ClientFile | None:
    """The file at the path of an address; None if there is none."""
    name = START if path == "/" else path.removeprefix("/client/")
    return _files().get(name) if path == "/" or path.startswith("/client/") else None


@cache
def _files() -> dict[str, ClientFile]:
    """By name; read once, so that a request reads no path that a client wrote."""
    texts = {f"{name}.wgsl": wgsl.source(name) for name in SHARED}
    for entry in resources.files(__name__).iterdir():
        if entry.name.rpartition(".")[2] in KINDS:
            before = wgsl.preamble("camera") if entry.name.endswith(".wgsl") else ""
            texts[entry.name] = before + entry.read_text("utf-8")
    return {name: _packed(name, text.encode()) for name, text in texts.items()}


def _packed(name: str, data: bytes) -> ClientFile:
    tag = f'"{hashlib.blake2b(data, digest_size=8).hexdigest()}"'
    return ClientFile(KINDS[name.rpartition(".")[2]], gzip.compress(data, mtime=0), tag)
