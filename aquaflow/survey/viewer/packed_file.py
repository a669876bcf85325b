"""``view.zip``: a finished dive's map as browsers get it, so that it is packed once.

A derived file: it is made when a dive is first looked at, is used as long as the files that it was
made of are the same, and may be removed at any time.
"""

from __future__ import annotations

import json
import logging
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aquaflow import __version__
from aquaflow.base.errors import InputError
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.survey.viewer.levels import Palette
from aquaflow.survey.viewer.packing import Packed

log = logging.getLogger(__name__)

NAME = "view.zip"
"""In a dive's folder (docs/formats.md#view)."""
SOURCES = (
    *("map.ply", "map_clear.ply", "medium.json", "metric.json", "trajectory.tum", "coverage.npz"),
)
"""Files of a dive that the packed map depends on."""
ABOUT = "about.json"
"""Member beside the chunks, which have numbers as names."""


@dataclass(frozen=True)
class PackedFile:
    """What :class:`aquaflow.survey.viewer.packing.Packed` offers, from a file."""

    about: dict[str, Any]
    palettes: dict[str, Palette]
    total: int
    """Gaussians of the map, those that are not shown included."""
    path: Path

    @property
    def version(self) -> str:
        """The same for the same content."""
        return str(self.about["version"])

    @property
    def count(self) -> int:
        """Gaussians."""
        return int(self.about["count"])

    def description(self) -> dict[str, Any]:
        """What a browser needs to read the chunks."""
        return dict(self.about)

    def chunk(self, number: int) -> bytes | None:
        """Gzipped; None if there is no such chunk, or the file is gone or another one by now."""
        if not 0 <= number < len(self.about["ends"]):
            return None
        try:
            with zipfile.ZipFile(self.path) as file:
                if json.loads(file.read(ABOUT))["map"]["version"] != self.version:
                    return None
                return file.read(str(number))
        except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
            log.warning("%s was removed or damaged while it was shown: %s", self.path, error)
            return None


def key_of(dive: Path, budget: int) -> dict[str, Any]:
    """By what a packed map is known to be of these files as they are now."""
    found: dict[str, Any] = {"aquaflow": __version__, "budget": budget}
    for name in SOURCES:
        try:
            stat = (dive / name).stat()
        except OSError:
            found[name] = None
        else:
            found[name] = [stat.st_size, stat.st_mtime_ns]
    return found


def read_packed(dive: Path, key: dict[str, Any]) -> PackedFile | None:
    """The packed map that was made with that ``key``; None where there is none, or no whole one."""
    path = dive / NAME
    try:
        with zipfile.ZipFile(path) as file:
            said = json.loads(file.read(ABOUT))
            if said["key"] != key:
                return None
            names, chunks = set(file.namelist()), range(len(said["map"]["ends"]))
            if not {str(number) for number in chunks} <= names:
                return None
        palettes = {name: _palette(each) for name, each in said["palettes"].items()}
        return PackedFile(said["map"], palettes, int(said["total"]), path)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        log.warning("%s is damaged and made anew: %s", path, error)
        return None


def write_packed(
    dive: Path, key: dict[str, Any], packed: Packed, palettes: dict[str, Palette], total: int
) -> None:
    """Keep a packed map for the next time; a folder that takes no file costs just that."""
    about = packed.description()
    said = {
        "key": key, "map": about, "total": total,
        "palettes": {name: each.to_json() for name, each in palettes.items()},
    }  # fmt: skip
    chunks = [packed.chunk(number) or b"" for number in range(len(about["ends"]))]
    try:
        with atomic_write(dive / NAME) as stream, zipfile.ZipFile(stream, "w") as file:
            file.writestr(ABOUT, json.dumps(said))
            for number, chunk in enumerate(chunks):
                file.writestr(str(number), chunk)
    except InputError as error:
        log.info("the packed map is not kept: %s", error)


def _palette(said: dict[str, Any]) -> Palette:
    stops = tuple((int(r), int(g), int(b)) for r, g, b in said["stops"])
    words = tuple(str(word) for word in said["words"])
    return Palette(said["label"], stops, words, float(said["largest"]), said["unit"])
