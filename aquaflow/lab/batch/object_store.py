"""Folders and files at a URL, by fsspec: s3://, gs://, file:// and what else it knows."""

from __future__ import annotations

import contextlib
import posixpath
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from aquaflow.base.errors import AquaFlowError, InputError, first_line

SEPARATOR = "://"


class StoreError(InputError):
    """An object store that does not answer as it should; it may the next time."""


@dataclass(frozen=True)
class StoredObject:
    """A file or folder in an object store."""

    name: str
    url: str
    is_folder: bool
    size_bytes: int
    """Of a folder: of everything in it."""


def is_url(text: str) -> bool:
    """True for an address in an object store, false for a path."""
    return SEPARATOR in text


class ObjectStore:
    """What lies below a URL."""

    def __init__(self, url: str) -> None:
        """Open nothing yet but the file system of ``url``.

        Raises:
            InputError: there is no package for such URLs, or it refuses this one.
        """
        self.url = url.rstrip("/")
        with _sentences(url):
            import fsspec

            self._system: Any
            self._system, root = fsspec.core.url_to_fs(self.url, use_listings_cache=False)
            self._root = str(root).rstrip("/")

    def entries(self) -> list[StoredObject]:
        """What lies right in the URL, by name; hidden names are left out.

        Raises:
            StoreError: it cannot be listed.
        """
        with _sentences(self.url):
            listed = self._system.ls(self._root, detail=True)
            found = []
            for each in listed:
                path = str(each["name"]).rstrip("/")
                name = posixpath.basename(path)
                if not name.startswith(".") and path != self._root:
                    url = f"{self.url}/{name}"
                    folder = each["type"] == "directory"
                    size = self._system.du(path) if folder else each["size"]
                    found.append(StoredObject(name, url, folder, int(size)))
        return sorted(found, key=lambda entry: entry.name)

    def size_bytes(self) -> int:
        """Size of the file, or of everything in the folder.

        Raises:
            StoreError: there is nothing.
        """
        with _sentences(self.url):
            return int(self._system.du(self._root))

    def fetch(self, into: Path) -> Path:
        """Copy the file or folder into the folder ``into``, under its own name; where it is then.

        Raises:
            StoreError: it cannot be read.
            OSError: the local disk does not take it.
        """
        target = into / PurePosixPath(self._root).name
        with _sentences(self.url):
            single = self._system.isfile(self._root)
            paths = [self._root] if single else self._system.find(self._root)
        if not paths:
            raise StoreError(f"there is nothing at {self.url}")
        for path in paths:
            within = "" if single else str(path)[len(self._root) :].lstrip("/")
            if ".." in PurePosixPath(within).parts:
                raise InputError(f"{self.url} holds a file '..', which is no name")
            local = target / within if within else target
            local.parent.mkdir(parents=True, exist_ok=True)
            with _sentences(self.url):
                self._system.get_file(path, str(local))
        return target

    def read(self, name: str) -> bytes | None:
        """Content of the file ``name``; None if there is none.

        Raises:
            StoreError: the store does not answer.
        """
        with _sentences(self.url):
            try:
                return bytes(self._system.cat_file(f"{self._root}/{name}"))
            except FileNotFoundError:
                return None

    def write(self, name: str, content: bytes) -> None:
        """Make the file ``name`` be ``content``.

        Raises:
            StoreError: the store does not take it.
        """
        with _sentences(self.url):
            path = f"{self._root}/{name}"
            self._make_parents(path)
            self._system.pipe_file(path, content)

    def put(self, local: Path, name: str) -> None:
        """Copy a local file to ``name``.

        Raises:
            StoreError: the store does not take it.
        """
        with _sentences(self.url):
            path = f"{self._root}/{name}"
            self._make_parents(path)
            self._system.put_file(str(local), path)

    def remove(self, name: str) -> None:
        """Remove what lies at ``name``, if anything.

        Raises:
            StoreError: the store does not let it be removed.
        """
        with _sentences(self.url), contextlib.suppress(FileNotFoundError):
            self._system.rm(f"{self._root}/{name}", recursive=True)

    def _make_parents(self, path: str) -> None:
        self._system.makedirs(posixpath.dirname(path), exist_ok=True)


@contextlib.contextmanager
def _sentences(url: str) -> Iterator[None]:
    try:
        yield
    except AquaFlowError:
        raise
    except ImportError as error:
        package = "pip install 'aquaflow[s3]'" if url.startswith("s3") else "its fsspec package"
        raise InputError(f"cannot open {url}: {first_line(error)}; it needs {package}") from error
    except Exception as error:
        raise StoreError(f"cannot use {url}: {first_line(error)}") from error
