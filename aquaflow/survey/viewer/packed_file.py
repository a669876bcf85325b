"""``view.zip``: a finished dive's map as browsers get it, so that it is packed once.

A derived file: it is made when a dive is first looked at, is used as long as the files that it was
made of are the same, and may be removed at any time.
"""

from __future__ import annotations

import json
import logging
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aquaflow import __version__
from aquaflow.base.errors import DamagedError, InputError, reason_of
from aquaflow.base.storage.archive import UNREADABLE, open_archive, read_member
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.survey.viewer.levels import Palette
from aquaflow.survey.viewer.packing import Packed, bytes_of_each, chunk_ends

log = logging.getLogger(__name__)

NAME = "view.zip"
"""In a dive's folder (docs/formats.md#view)."""
SOURCES = (
    *("map.ply", "map_clear.ply", "medium.json", "metric.json", "trajectory.tum", "coverage.npz"),
)
"""Files of a dive that the packed map depends on."""
ABOUT = "about.json"
"""Member beside the chunks, which have numbers as names."""
MOST_ABOUT_BYTES = 1 << 20
"""It has some kB: palettes and 10 to 20 chunks' ends."""
MOST_GAUSSIANS = 1 << 22
"""More are packed at every look: a browser shows some 500,000."""
MOST_LEVELS = 16
"""Of a Gaussian; a dive has at most 4."""
GZIP_BYTES, BLOCK_BYTES = 1024, 1 << 16
"""A header and an end take 18; unpacked at once."""


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
            with open_archive(self.path, stored=True) as file:
                if _about(file)["map"]["version"] != self.version:
                    return None
                return self._chunk(file, number)
        except UNREADABLE as error:
            log.warning("%s was removed or damaged while it was shown: %s", self.path, error)
            return None

    def _chunk(self, file: zipfile.ZipFile, number: int) -> bytes:
        """Of the length that its Gaussians have, also in a browser, which unpacks it."""
        ends = (0, *self.about["ends"])
        size = (ends[number + 1] - ends[number]) * bytes_of_each(len(self.about["levels"]))
        packed = read_member(file, str(number), most_bytes=size + size // 64 + GZIP_BYTES)
        unpacking, waiting, there = zlib.decompressobj(zlib.MAX_WBITS | 16), packed, 0
        while not unpacking.eof and there <= size:
            block = unpacking.decompress(waiting, BLOCK_BYTES)
            waiting = unpacking.unconsumed_tail
            if not block and not waiting:  # it is cut short
                break
            there += len(block)
        if there != size or not unpacking.eof or unpacking.unused_data:
            raise DamagedError("a chunk is longer or shorter than its Gaussians")
        return packed


def key_of(dive: Path, budget: int) -> dict[str, Any]:
    """By what a packed map is known to be of these files as they are now."""
    found: dict[str, Any] = {"aquaflow": __version__, "budget": budget}
    for name in SOURCES:
        try:
            stat = (dive / name).lstat()
        except OSError:
            found[name] = None
        else:
            found[name] = [stat.st_size, stat.st_mtime_ns]
    return found


def read_packed(dive: Path, key: dict[str, Any]) -> PackedFile | None:
    """The packed map that was made with that ``key``; None where there is none, or no whole one."""
    path = dive / NAME
    try:
        with open_archive(path, stored=True) as file:
            said = _about(file)
            if said["key"] != key:
                return None
            names, chunks = set(file.namelist()), range(len(said["map"]["ends"]))
            count = int(said["map"]["count"])
            if count > MOST_GAUSSIANS or said["map"]["ends"] != chunk_ends(count):
                raise DamagedError("its chunks are no chunks of its Gaussians, or too many")
            if len(said["map"]["levels"]) > MOST_LEVELS:
                raise DamagedError("its Gaussians have too many levels")
            if not {str(number) for number in chunks} <= names:
                return None
        palettes = {name: _palette(each) for name, each in said["palettes"].items()}
        return PackedFile(said["map"], palettes, int(said["total"]), path)
    except FileNotFoundError:
        return None
    except UNREADABLE as error:
        log.warning("%s is damaged and made anew: %s", path, reason_of(error))
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


def _about(file: zipfile.ZipFile) -> Any:
    return json.loads(read_member(file, ABOUT, MOST_ABOUT_BYTES))


def _palette(said: dict[str, Any]) -> Palette:
    stops = tuple((int(r), int(g), int(b)) for r, g, b in said["stops"])
    words = tuple(str(word) for word in said["words"])
    return Palette(said["label"], stops, words, float(said["largest"]), said["unit"])
