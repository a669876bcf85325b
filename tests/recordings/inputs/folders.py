"""Folders of pictures: formats, depths, names, times, what lies among them."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from aquaflow.geometry.camera import save_camera
from tests.recordings.inputs import NEAR, Dive, Made, Picture, made, row, write_png

Write = Callable[[Path, Picture], object]


def _folder(
    dive: Dive, folder: Path, write: Write, suffix: str, pictures: Sequence[Picture] | None = None
) -> Path:
    """The pictures with numbers for names, with their times."""
    for index, picture in enumerate(dive.pictures if pictures is None else pictures):
        write(folder / f"{index:04d}{suffix}", picture)
    (folder / "timestamps.txt").write_text("\n".join(map(str, dive.times_s)))
    return folder


def _read_as(dive: Dive, folder: Path, suffix: str, **changes: object) -> Made:
    """A folder whose plain reading are the pictures that OpenCV decodes."""
    bgr = [cv2.imread(str(file)) for file in sorted(folder.glob(f"*{suffix}"))]
    plain = [np.ascontiguousarray(each[..., ::-1]) for each in bgr]
    return made(dive, folder, plain=plain, **changes)


def _by_pillow(mode: str = "RGB", **options: Any) -> Write:
    def write(path: Path, picture: Picture) -> None:
        Image.fromarray(picture).convert(mode).save(path, **options)

    return write


FORMATS: list[tuple[str, str, Write, float]] = [
    ("PNG", ".png", _by_pillow(), 0.0),
    ("PNG with transparency", ".PNG", _by_pillow("RGBA"), 0.0),
    ("JPEG", ".jpg", _by_pillow(quality=98), 2.0),
    ("JPEG, progressive, 4:4:4", ".jpeg", _by_pillow(quality=98, progressive=True), 2.0),
    ("JPEG, CMYK", ".jpg", _by_pillow("CMYK", quality=98), NEAR),
    ("TIFF", ".tif", _by_pillow(), 0.0),
    ("TIFF, LZW", ".tiff", _by_pillow(compression="tiff_lzw"), 0.0),
    ("BMP", ".bmp", _by_pillow(), 0.0),
    ("WebP", ".webp", _by_pillow(lossless=True), 0.0),
    ("PPM", ".ppm", _by_pillow(), 0.0),
]


def _format(name: str, suffix: str, write: Write, near: float) -> None:
    @row(f"folder {name}", near=near, says="the times of the pictures are those of ")
    def _made(dive: Dive, folder: Path) -> Made:
        return _read_as(dive, _folder(dive, folder, write, suffix), suffix)


for _each in FORMATS:
    _format(*_each)


@row("folder grey PNG", near=0.0)
def _grey(dive: Dive, folder: Path) -> Made:
    grey = [np.repeat(each[..., 1:2], 3, axis=2) for each in dive.pictures]
    path = _folder(dive, folder, lambda path, each: write_png(path, each[..., 0]), ".png", grey)
    return made(dive, path, pictures=grey)


def _wide(bits: int, suffix: str, grey: bool, stated: bool) -> None:
    said = "as their header says" if stated else f"white is assumed to be {(1 << bits) - 1}"
    name = f"folder {bits} bits {'grey' if grey else 'colour'} {suffix}"

    @row(name + (", white stated" if stated else ", first picture dark"), near=0.0, says=said)
    def _made(dive: Dive, folder: Path) -> Made:
        pictures = list(dive.pictures)
        if grey:
            pictures = [np.repeat(each[..., 1:2], 3, axis=2) for each in pictures]
        # A picture that fits 12 bits, in front of the others, must not decide for them.
        pictures[0] = pictures[0] // 17

        def write(path: Path, each: Picture) -> None:
            shown = each[..., 0] if grey else each
            wide = (shown.astype(np.uint16) << (bits - 8)) + (1 << (bits - 9))
            if stated:
                image = Image.fromarray(wide)
                image.save(path, tiffinfo={281: (1 << bits) - 1})
            else:
                write_png(path, wide)

        return made(dive, _folder(dive, folder, write, suffix, pictures), pictures=pictures)


for _bits in (12, 16):
    for _suffix in (".png", ".tif"):
        for _grey_ in (True, False):
            _wide(_bits, _suffix, _grey_, stated=False)
_wide(12, ".tiff", grey=True, stated=True)


def _names(kind: str, name: Callable[[float, int], str], says: str) -> None:
    @row(f"folder names are {kind}", near=0.0, says=says)
    def _made(dive: Dive, folder: Path) -> Made:
        times_s = [0.0, 0.133, 0.4, 0.5, 0.61, 0.7, 0.8, 0.9, 1.05, 1.1, 1.2, 1.3, 1.45, 1.5]
        for index, picture in enumerate(dive.pictures):
            write_png(folder / name(times_s[index], index), picture)
        return made(dive, folder, times_s=times_s)


_names(
    "decimal seconds", lambda t, _: f"{t + 9.0:.2f}{'3.png' if t == 0.133 else '.png'}", "the sec"
)
_names("ns since 1970", lambda t, _: f"{1403636579_000000000 + round(t * 1e9)}.png", "since 1970")
_names("ms since 1970", lambda t, _: f"left_{1700000000_000 + round(t * 1e3)}.png", "since 1970")
_names("seconds since 1970", lambda t, _: f"{1305031102.1753 + t:.6f}.png", "since 1970")
_names(
    "dates", lambda t, k: f"cam_2024-05-01T10-00-{59 + t if t < 1 else t - 1:06.3f}.png"
    if t < 1 else f"cam_2024-05-01T10-01-{t - 1:06.3f}.png", "the dates in their names",
)  # fmt: skip


@row("folder numbers without zeros, --fps", near=0.0, says="the 10 a second that were given")
def _numbers(dive: Dive, folder: Path) -> Made:
    for index, picture in enumerate(dive.pictures):
        write_png(folder / f"frame{index + 1}.png", picture)
    return made(dive, folder, fps=10.0)


@row("folder without any times", near=0.0, says="10 a second are assumed")
def _no_times(dive: Dive, folder: Path) -> Made:
    for index, picture in enumerate(dive.pictures):
        write_png(folder / f"GOPR{index:04d}.png", picture)
    return made(dive, folder)


@row("folder with times in EXIF", near=2.0, says="those of their EXIF")
def _exif(dive: Dive, folder: Path) -> Made:
    for index, picture in enumerate(dive.pictures):
        exif = Image.Exif()
        taken = exif.get_ifd(0x8769)
        taken[0x9003] = f"2024:05:01 10:00:{index // 2:02d}"
        taken[0x9291] = str(5 * (index % 2))
        Image.fromarray(picture).save(folder / f"DSC{index:05d}.JPG", quality=98, exif=exif)
    times_s = [0.5 * index for index in range(len(dive.pictures))]
    return _read_as(dive, folder, ".JPG", times_s=times_s)


TURNS = {3: 2, 6: 1, 8: -1}
"""Orientation of EXIF, and quarter turns to the left that bring an upright picture there."""


def _orientation(number: int) -> None:
    @row(f"folder with EXIF orientation {number}", near=2.0, says="turned as their EXIF says")
    def _made(dive: Dive, folder: Path) -> Made:
        exif = Image.Exif()
        exif[0x0112] = number

        def write(path: Path, picture: Picture) -> None:
            turned = np.rot90(picture, TURNS[number])
            Image.fromarray(np.ascontiguousarray(turned)).save(path, quality=98, exif=exif)

        return _read_as(dive, _folder(dive, folder, write, ".jpg"), ".jpg")


for _number in TURNS:
    _orientation(_number)


@row("folder with its images and camera.yaml in it", near=0.0, says="the calibration is ")
def _subfolder(dive: Dive, folder: Path) -> Made:
    (folder / "images").mkdir()
    _folder(dive, folder / "images", write_png, ".png")
    shutil.move(folder / "images" / "timestamps.txt", folder / "timestamps.txt")
    save_camera(dive.camera, folder / "camera.yaml")
    return made(dive, folder, camera=dive.camera)


@row("folder with a picture of another size and a damaged one", near=0.0, says="2 of 14 pictures")
def _odd_ones(dive: Dive, folder: Path) -> Made:
    pictures: list[Picture | None] = list(dive.pictures)
    _folder(dive, folder, write_png, ".png")
    cv2.imwrite(str(folder / "0005.png"), np.zeros((30, 40, 3), np.uint8))
    (folder / "0009.png").write_bytes((folder / "0009.png").read_bytes()[:200])
    pictures[5] = pictures[9] = None
    return made(dive, folder, pictures=pictures)


@row("folder whose times go back", refuses="the time does not come after the one before it")
def _back(dive: Dive, folder: Path) -> Made:
    _folder(dive, folder, write_png, ".png")
    (folder / "timestamps.txt").write_text("\n".join(map(str, reversed(dive.times_s))))
    return made(dive, folder)


@row("folder with fewer times than pictures", refuses="holds 13 times for 14 pictures")
def _few(dive: Dive, folder: Path) -> Made:
    _folder(dive, folder, write_png, ".png")
    (folder / "timestamps.txt").write_text("\n".join(map(str, dive.times_s[1:])))
    return made(dive, folder)


@row("folder without pictures", refuses="holds no picture")
def _none(dive: Dive, folder: Path) -> Made:
    (folder / "notes.docx").touch()
    return made(dive, folder)


def _still(name: str, says: str, change: Callable[[Picture], Picture]) -> None:
    @row(f"folder of pictures {name}", refuses=says)
    def _made(dive: Dive, folder: Path) -> Made:
        pictures = [change(dive.pictures[0]) for _ in dive.pictures]
        return made(dive, _folder(dive, folder, write_png, ".png", pictures))


_still("of one colour", "pictures are of one colour", lambda each: np.full_like(each, 90))
_still("that are black", "pictures are nearly black", lambda each: each // 100)
_still("that are white", "pictures are nearly white", lambda each: 255 - each // 100)
_still("that all show the same", "nothing moves: all pictures show the same", lambda each: each)


@row("folder with places in EXIF", near=2.0, says="those of their EXIF")
def _places(dive: Dive, folder: Path) -> Made:
    fixes = []
    for index, picture in enumerate(dive.pictures):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0x9003] = f"2024:05:01 10:00:{index:02d}"
        place = exif.get_ifd(0x8825)
        place[1], place[2] = "S", (41.0, 15.0, float(index))
        place[3], place[4], place[31] = "E", (174.0, 48.0, 0.0), 3.5
        fixes.append((float(index), -41.25 - index / 3600.0, 174.8, 3.5))
        Image.fromarray(picture).save(folder / f"DJI_{index:04d}.JPG", quality=98, exif=exif)
    times_s = [float(index) for index in range(len(dive.pictures))]
    return _read_as(dive, folder, ".JPG", times_s=times_s, log=folder, fixes=fixes)
