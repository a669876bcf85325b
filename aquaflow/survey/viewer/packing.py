"""Gaussians as few bytes, in chunks: the first is a picture already, each further one refines it.

A Gaussian takes 17 bytes and one more for each of its levels, before gzip. Columns follow each
other within a chunk (all x, all y, ...), because equal kinds of bytes compress better together:

    x, y, z     uint16 each   contracted, see ``contract``
    rotation    4 int8        w, x, y, z of the unit quaternion with w >= 0, times 127
    scales      3 uint8       logarithm, between ``log_scales`` of the description
    opacity     uint8         times 255
    colour      3 uint8       times 255 / ``brightest`` of the description
    levels      uint8 each    in the order of ``levels``
"""

from __future__ import annotations

import gzip
import hashlib
import json
import logging
import threading
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from aquaflow import __version__
from aquaflow.base.errors import DamagedError, InputError, reason_of
from aquaflow.base.storage.archive import UNREADABLE, open_archive, read_member
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.survey.viewer.levels import Palette
from aquaflow.survey.viewer.splats import Float, ViewerSplats

FIRST_CHUNK = 16_384
"""Gaussians of the first chunk: 0.25 MB, 0.2 s at 10 Mbit/s. Each further one doubles what is
there. A multiple of 1024, a row of the page's texture."""
INNER_SHARE = (1.0, 99.0)
"""Percentiles of the coordinates between which positions are uniform; beyond, they are contracted
(J. Barron et al., Mip-NeRF 360, eq. 10, along each axis): one far away costs no precision."""
GZIP_LEVEL = 5
"""9 takes three times as long for 1 % fewer bytes."""
LARGEST = 65_535
"""Of 16 bits."""


@dataclass(frozen=True)
class PackedCode:
    """What numbers of bytes stand for."""

    middle: npt.NDArray[np.float64]
    half: npt.NDArray[np.float64]
    """[3] of the box within which positions are uniform."""
    log_scales: tuple[float, float]
    brightest: float

    @staticmethod
    def of(splats: ViewerSplats, others: ViewerSplats | None = None) -> PackedCode:
        """The code for these Gaussians, and for scales as those of ``others``."""
        middle, half = inner_box(splats.centres)
        scales = splats.scales
        if others is not None:
            scales = np.concatenate([scales, others.scales])
        return PackedCode(middle, half, _log_scales(scales), _brightest(splats.colours))

    def in_box(
        self,
        middle: npt.NDArray[np.float64],  # [3]
        half: npt.NDArray[np.float64],  # [3]
    ) -> PackedCode:
        """The same for places around another middle."""
        return replace(self, middle=middle, half=half)


class MoreDetail(Protocol):
    """Tiles of a map of which the chunks are only what covers most (map_tiles.py)."""

    @property
    def code(self) -> PackedCode:
        """Of the bytes of all parts."""
        ...

    def description(self) -> dict[str, Any]:
        """What a browser needs to choose tiles and to read them."""
        ...

    def parts(self) -> Iterator[tuple[int, int]]:
        """Numbers of each tile and each of its parts."""
        ...

    def part(self, number: int, part: int) -> bytes | None:
        """Gzipped; None if there is no such part."""
        ...


class Packed:
    """Splats as a description and chunks of bytes, which are packed when first asked for."""

    def __init__(self, splats: ViewerSplats, tiles: MoreDetail | None = None) -> None:
        self._splats, self.tiles = splats, tiles
        self._ends = chunk_ends(len(splats))
        self._chunks: dict[int, bytes] = {}
        self._lock = threading.Lock()

    @property
    def count(self) -> int:
        """Gaussians."""
        return len(self._splats)

    @cached_property
    def version(self) -> str:
        """The same for the same content: a browser keeps the chunks that it has seen before."""
        return _digest(self._splats)

    @cached_property
    def _code(self) -> PackedCode:
        return PackedCode.of(self._splats) if self.tiles is None else self.tiles.code

    @cached_property
    def _tiles(self) -> dict[str, Any]:
        return {} if self.tiles is None else {"tiles": self.tiles.description()}

    @cached_property
    def _covered(self) -> list[float]:
        """Share of what the Gaussians cover that each chunk ends at."""
        weight = self._splats.weights().astype(np.float64)
        weight[: self._splats.floaters] = 0.0
        covered = np.cumsum(weight)[[end - 1 for end in self._ends]] if self._ends else np.zeros(0)
        shares: list[float] = (covered / max(float(weight.sum()), 1e-300)).tolist()
        return shares

    def description(self) -> dict[str, Any]:
        """What a browser needs to read the chunks."""
        return {
            "version": self.version,
            "count": len(self._splats),
            "floaters": self._splats.floaters,
            "ends": self._ends,
            "covered": self._covered,
            "middle": self._code.middle.tolist(),
            "half": self._code.half.tolist(),
            "log_scales": self._code.log_scales,
            "brightest": self._code.brightest,
            "levels": list(self._splats.levels),
            **self._tiles,
        }

    def chunk(self, number: int) -> bytes | None:
        """Gzipped; None if there is no such chunk."""
        if not 0 <= number < len(self._ends):
            return None
        with self._lock:
            if number not in self._chunks:
                first = self._ends[number - 1] if number else 0
                part = self._splats.among(slice(first, self._ends[number]))
                raw = columns_of(part, self._code)
                self._chunks[number] = gzip.compress(raw, GZIP_LEVEL, mtime=0)
            return self._chunks[number]


def columns_of(shown: ViewerSplats, code: PackedCode) -> bytes:
    """The columns of a chunk."""
    inside = contract(shown.centres.astype(np.float64), code.middle, code.half)
    places = np.rint((inside + 2.0) * (LARGEST / 4.0)).astype("<u2")
    turned = np.where(shown.wxyz[:, :1] < 0.0, -shown.wxyz, shown.wxyz)
    low, high = code.log_scales
    scales = (np.log(np.maximum(shown.scales, 1e-30)) - low) / (high - low)
    columns = [
        np.rint(127.0 * turned).astype(np.int8),
        _bytes(scales),
        _bytes(shown.opacities[:, None]),
        _bytes(shown.colours / code.brightest),
        *(values[:, None] for values in shown.levels.values()),
    ]
    return b"".join(np.ascontiguousarray(each.T).tobytes() for each in (places, *columns))


def bytes_of_each(levels: int) -> int:
    """Bytes of a Gaussian in a chunk, before gzip: 6 for its place, then 4, 3, 1 and 3."""
    return 17 + levels


def chunk_ends(count: int) -> list[int]:
    """Where each chunk ends, of ``count`` Gaussians: the first fixed, then as much as came."""
    ends = []
    end = FIRST_CHUNK
    while count > 0 and end < count:
        ends.append(end)
        end *= 2
    return [*ends, count] if count else []


def contract(
    places: npt.NDArray[np.float64],  # [N, 3]
    middle: npt.NDArray[np.float64],  # [3]
    half: npt.NDArray[np.float64],  # [3]
) -> npt.NDArray[np.float64]:
    """[N, 3] within [-2, 2]: x inside of the box, sign(x) (2 - 1 / |x|) outside."""
    x = (places - middle) / half
    far = np.maximum(np.abs(x), 1.0)
    return np.asarray(np.where(np.abs(x) <= 1.0, x, np.sign(x) * (2.0 - 1.0 / far)))


def _bytes(
    shares: npt.NDArray[np.floating[Any]],  # [N, C] in [0, 1], others are clipped
) -> npt.NDArray[np.uint8]:
    return np.asarray(np.rint(255.0 * np.clip(shares, 0.0, 1.0)), np.uint8)


def inner_box(
    centres: Float,  # [N, 3]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Middle and half the size [3] of the box that holds nearly all; the same size each way."""
    if not len(centres):
        return np.zeros(3), np.ones(3)
    low, high = np.percentile(centres.astype(np.float64), INNER_SHARE, axis=0)
    half = max(float((high - low).max()) / 2.0, 1e-6)
    return (low + high) / 2.0, np.full(3, half)


def _log_scales(
    scales: Float,  # [N, 3]
) -> tuple[float, float]:
    logs = np.log(np.maximum(scales, 1e-30))
    if not logs.size:
        return 0.0, 1.0
    low, high = np.percentile(logs, 0.1), float(logs.max())
    return float(low), max(high, float(low) + 1e-3)


def _brightest(
    colours: Float,  # [N, 3]
) -> float:
    """Colours without water may exceed 1, which brighter water or shadow brings back."""
    return float(np.clip(np.percentile(colours, 99.9), 1.0, 2.0)) if colours.size else 1.0


def _digest(splats: ViewerSplats) -> str:
    digest = hashlib.blake2b(digest_size=8)
    arrays = (splats.centres, splats.wxyz, splats.scales, splats.opacities, splats.colours)
    for each in (*arrays, *splats.levels.values()):
        digest.update(np.ascontiguousarray(each).data)
    return digest.hexdigest()


# --------------------------------------------------------------------------------------------------
# ``view.zip``: a finished dive's map as browsers get it, so that it is packed once.
#
# A derived file: it is made when a dive is first looked at, is used as long as the files that it
# was made of are the same, and may be removed at any time.

log = logging.getLogger(__name__)

NAME = "view.zip"
"""In a dive's folder (docs/formats.md#view)."""
FORMAT = 3
"""Raised whenever a browser is sent something else of the same files."""
SOURCES = (
    *(
        "map.ply",
        "map_clear.ply",
        "medium.json",
        "metric.json",
        "trajectory.tum",
        "coverage.npz",
        "camera.yaml",
    ),
)
"""Files of a dive that the packed map depends on."""
ABOUT = "about.json"
"""Member beside the chunks, which have numbers as names."""
MOST_ABOUT_BYTES = 1 << 22
"""It has some kB: palettes, 10 to 20 chunks' ends, and 250 bytes of each tile."""
MOST_GAUSSIANS = 1 << 22
"""More are packed at every look: a browser shows some 500,000."""
MOST_TILES, MOST_PARTS, MOST_IN_PART = 1 << 14, 4, 1 << 17
"""Of a map in a file; tiles have two parts and some 30,000 Gaussians."""
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

    @property
    def at_once(self) -> int:
        """Gaussians that a browser shows at most."""
        return int(self.about["tiles"]["budget"]) if "tiles" in self.about else self.count

    def description(self) -> dict[str, Any]:
        """What a browser needs to read the chunks."""
        return dict(self.about)

    def chunk(self, number: int) -> bytes | None:
        """Gzipped; None if there is no such chunk, or the file is gone or another one by now."""
        if not 0 <= number < len(self.about["ends"]):
            return None
        return self.member(str(number), (0, *self.about["ends"])[number : number + 2])

    def member(self, name: str, ends: Sequence[int]) -> bytes | None:
        """Gzipped, with the Gaussians between both ``ends``."""
        count = ends[1] - ends[0]
        try:
            with open_archive(self.path, stored=True) as file:
                if _about(file)["map"]["version"] != self.version:
                    return None
                return _whole(file, name, count * bytes_of_each(len(self.about["levels"])))
        except UNREADABLE as error:
            log.warning("%s was removed or damaged while it was shown: %s", self.path, error)
            return None

    @property
    def tiles(self) -> PackedTiles | None:
        """Those of a large map."""
        return PackedTiles(self) if "tiles" in self.about else None


@dataclass(frozen=True)
class PackedTiles:
    """The tiles of a map in a file."""

    file: PackedFile

    def part(self, number: int, part: int) -> bytes | None:
        """Gzipped; None if there is no such part, or the file is gone or another one by now."""
        tiles = self.file.about["tiles"]["list"]
        if not (0 <= number < len(tiles) and 0 <= part < len(tiles[number]["ends"])):
            return None
        ends = (0, *tiles[number]["ends"])
        return self.file.member(_name(number, part), ends[part : part + 2])


def _name(number: int, part: int) -> str:
    """Of a part of a tile in the file."""
    return f"tile {number} {part}"


def _whole(file: zipfile.ZipFile, name: str, size: int) -> bytes:
    """A member that unpacks to ``size`` bytes, also in a browser, which unpacks it."""
    packed = read_member(file, name, most_bytes=size + size // 64 + GZIP_BYTES)
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
    found: dict[str, Any] = {"aquaflow": __version__, "format": FORMAT, "budget": budget}
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
            if not {str(number) for number in chunks} | _tile_names(said["map"]) <= names:
                return None
        palettes = {name: _palette(each) for name, each in said["palettes"].items()}
        return PackedFile(said["map"], palettes, int(said["total"]), path)
    except FileNotFoundError:
        return None
    except UNREADABLE as error:
        log.warning("%s is damaged and made anew: %s", path, reason_of(error))
        return None


def _tile_names(about: dict[str, Any]) -> set[str]:
    """Of all parts of all tiles.

    Raises:
        DamagedError: they are no tiles, or too many.
    """
    names = set()
    for number, tile in enumerate(about.get("tiles", {"list": []})["list"]):
        ends = tile["ends"]
        if not all(isinstance(end, int) and 0 < end <= MOST_IN_PART for end in ends):
            raise DamagedError("its tiles have no Gaussians, or too many")
        if number >= MOST_TILES or len(ends) > MOST_PARTS or list(ends) != sorted(ends):
            raise DamagedError("it has too many tiles, or some of no order")
        names |= {_name(number, part) for part in range(len(ends))}
    return names


def write_packed(
    dive: Path, key: dict[str, Any], packed: Packed, palettes: dict[str, Palette], total: int
) -> None:
    """Keep a packed map for the next time; a folder that takes no file costs just that."""
    about = packed.description()
    said = {
        "key": key, "map": about, "total": total,
        "palettes": {name: each.to_json() for name, each in palettes.items()},
    }  # fmt: skip
    tiles = packed.tiles
    try:
        with atomic_write(dive / NAME) as stream, zipfile.ZipFile(stream, "w") as file:
            file.writestr(ABOUT, json.dumps(said))
            for number in range(len(about["ends"])):
                file.writestr(str(number), packed.chunk(number) or b"")
            if tiles is not None:
                for number, part in tiles.parts():
                    file.writestr(_name(number, part), tiles.part(number, part) or b"")
    except InputError as error:
        log.info("the packed map is not kept: %s", error)


def _about(file: zipfile.ZipFile) -> Any:
    return json.loads(read_member(file, ABOUT, MOST_ABOUT_BYTES))


def _palette(said: dict[str, Any]) -> Palette:
    stops = tuple((int(r), int(g), int(b)) for r, g, b in said["stops"])
    words = tuple(str(word) for word in said["words"])
    return Palette(said["label"], stops, words, float(said["largest"]), said["unit"])
