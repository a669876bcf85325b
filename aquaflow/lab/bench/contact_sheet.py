"""Many dives in one picture, a row each: the camera's picture, restored, and the truth if known.

    python -m aquaflow.lab.bench.contact_sheet OUT.jpg DIVE[=CLEAN] ...

Shown is the middle held-out view of each dive, as it lies in the dive folder: no gain is fitted to
any truth. CLEAN is the same recording without water, or a synthetic dive; of a recording named
``*side_by_side*`` the right half is taken, as in ``aquaflow lab bench --suite real``.
"""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from aquaflow.base.errors import AquaFlowError, InputError
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.lab.bench.scene import SIDE_BY_SIDE
from aquaflow.lab.evaluation.held_out import Picture, held_out_indices, read_picture
from aquaflow.lab.evaluation.restoration import clean_pictures

if TYPE_CHECKING:
    from PIL.Image import Image

TITLES = ("camera", "restored, no gains", "truth")
TILE_PX = 240
"""Width of one picture."""
GAP_PX, LINE_PX = 4, 20
"""Between pictures; height of a line of text."""
FONT_PX = 13
PAPER, INK, NOTHING = "#ffffff", "#343a40", "#808080"
"""Background, text, and where there is no picture or it is transparent."""
FORMATS = {".jpg": "JPEG", ".jpeg": "JPEG", ".png": "PNG"}
JPEG_QUALITY = 85
MAX_BYTES = 1_000_000
"""A documentation page loads the whole sheet."""


@dataclass(frozen=True)
class Row:
    """One dive on the sheet."""

    name: str
    camera: Picture
    restored: Picture | None
    """None where the dive was found clear."""
    truth: Picture | None


def read_row(dive: Path, clean: Path | None = None) -> Row:
    """The middle held-out view of a dive.

    Raises:
        InputError: the dive has no held-out view, or a picture cannot be read.
    """
    indices = held_out_indices(dive, "real")
    if not indices:
        raise InputError(f"{dive} holds no held-out views; give a dive folder that was mapped")
    index = indices[len(indices) // 2]
    restored, truth = None, None
    if index in held_out_indices(dive, "restored"):
        picture, opaque = read_picture(dive, index, "restored")
        backing = np.uint8(int(NOTHING[1:3], 16))
        restored = np.where(opaque[..., None], picture, backing)
    if clean is not None:
        crop = "right" if SIDE_BY_SIDE in clean.name else None
        truth = (clean_pictures(dive, clean, crop, [index])[0] * 255.0 + 0.5).astype(np.uint8)
    return Row(dive.resolve().name, read_picture(dive, index, "real")[0], restored, truth)


def draw(rows: Sequence[Row]) -> Image:
    """The sheet."""
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default(FONT_PX)
    heights = [round(TILE_PX * row.camera.shape[0] / row.camera.shape[1]) for row in rows]
    width = len(TITLES) * (TILE_PX + GAP_PX) + GAP_PX
    sheet = Image.new("RGB", (width, LINE_PX + sum(heights) + len(rows) * LINE_PX + GAP_PX), PAPER)
    pen = ImageDraw.Draw(sheet)
    lefts = [GAP_PX + i * (TILE_PX + GAP_PX) for i in range(len(TITLES))]
    for left, title in zip(lefts, TITLES, strict=True):
        pen.text((left, 2), title, INK, font)
    top = LINE_PX
    for row, height in zip(rows, heights, strict=True):
        pen.text((GAP_PX, top + 2), row.name, INK, font)
        top += LINE_PX
        missing = ("", "found clear", "not known")
        for left, tile, said in zip(
            lefts, (row.camera, row.restored, row.truth), missing, strict=True
        ):
            if tile is None:
                pen.rectangle((left, top, left + TILE_PX - 1, top + height - 1), NOTHING)
                pen.text((left + GAP_PX, top + 2), said, PAPER, font)
                continue
            small = Image.fromarray(tile).resize((TILE_PX, height), Image.Resampling.LANCZOS)
            sheet.paste(small, (left, top))
        top += height
    return sheet


def write(sheet: Image, path: Path) -> None:
    """Write the sheet as JPEG or PNG, as the file's name says.

    Raises:
        InputError: the name says neither, the file is too large for a page, or cannot be written.
    """
    form = FORMATS.get(path.suffix.lower())
    if form is None:
        raise InputError(f"{path} must end in one of {', '.join(FORMATS)}")
    buffer = io.BytesIO()
    sheet.save(buffer, form, quality=JPEG_QUALITY, optimize=True)
    if buffer.tell() > MAX_BYTES:
        raise InputError(
            f"the sheet would take {buffer.tell() / 1e6:.1f} MB, more than {MAX_BYTES / 1e6:.0f}; "
            "give fewer dives, or a name that ends in .jpg"
        )
    with atomic_write(path) as stream:
        stream.write(buffer.getvalue())


def main(arguments: Sequence[str] | None = None) -> None:
    """Read the dives and write the sheet."""
    parser = argparse.ArgumentParser(prog="python -m aquaflow.lab.bench.contact_sheet")
    parser.add_argument("out", type=Path, help="the sheet, .jpg or .png")
    parser.add_argument("dives", nargs="+", metavar="DIVE[=CLEAN]")
    asked = parser.parse_args(arguments)
    try:
        rows = []
        for text in asked.dives:
            dive, _, clean = text.partition("=")
            rows.append(read_row(Path(dive), Path(clean) if clean else None))
        write(draw(rows), asked.out)
    except AquaFlowError as error:
        sys.exit(f"Error: {error}")


if __name__ == "__main__":
    main()
