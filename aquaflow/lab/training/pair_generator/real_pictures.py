"""Pairs from the pictures and clips of a folder: real texture, exact matches, no range.

Each picture is taken for a distant plane and seen twice by a camera that turns and zooms, so that
the pair is related by a homography.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import torch

from aquaflow.base.errors import InputError
from aquaflow.lab.training.pair_generator.cameras import intrinsics
from aquaflow.lab.training.pair_generator.drawing import turned_view
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pair_generator.scene import rotation
from aquaflow.lab.training.pairs import Pair, ViewBatch

PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
CLIPS = (".mp4", ".mov", ".avi", ".mkv")
FRAMES_OF_A_CLIP = 48
"""Evenly over the clip: neighbours show the same."""
LEAST_DETAIL = 1.5
"""Deviation of grey, of 255, about its surroundings, below which a crop shows open water."""
SURROUNDINGS_PX = 9
"""Width of the box that a crop's detail is what remains without."""
TILT = 0.2
"""Radians, deviation of the second view about the axes of the picture."""

Picture = npt.NDArray[np.uint8]


class RealPictures:
    """Pictures of one size in memory: each file whole, and its quarters, which show more detail."""

    def __init__(self, folders: Sequence[Path], width: int, height: int) -> None:
        """Read all pictures and clips directly in ``folders``.

        Raises:
            InputError: a folder does not exist or holds no picture that can be read.
        """
        self.width, self.height = width, height
        rows: list[Picture] = []
        for folder in folders:
            found = [
                crop for picture in _pictures_in(folder) for crop in _crops(picture, width, height)
            ]
            if not found:
                raise InputError(f"{folder} holds no textured picture or clip that can be read")
            rows += found
        self.images = torch.from_numpy(np.stack(rows)).permute(0, 3, 1, 2).contiguous()
        """[N, 3, H, W] uint8 RGB"""

    def pairs(self, draw: Draw, batch: int) -> Pair:
        """``batch`` pairs of some pictures; b is turned, and both have the depth of a plane."""
        chosen = draw.whole(batch, below=len(self.images)).cpu()
        image = self.images[chosen].to(draw.device).float() / 255.0
        ones = torch.ones(batch, self.height, self.width, device=draw.device)
        K = intrinsics(draw, batch, self.width, self.height)
        T_wc = torch.eye(4, device=draw.device).repeat(batch, 1, 1)
        a = ViewBatch(image, ones, K, T_wc, ones > 0)
        turn = draw.normal(batch, 3, sigma=TILT)
        turn[:, 2] = 0.0
        return Pair(a, turned_view(a, K, rotation(turn), self.width, self.height))


def _pictures_in(folder: Path) -> Iterator[Picture]:
    """[H, W, 3] RGB, by the files' names; what cannot be read is left out."""
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder; give one of pictures or clips")
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in PICTURES:
            picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
            if picture is not None:
                yield np.ascontiguousarray(picture[..., ::-1])
        elif path.suffix.lower() in CLIPS:
            yield from _frames(path)


def _frames(path: Path) -> Iterator[Picture]:
    clip = cv2.VideoCapture(str(path))
    step = max(1, int(clip.get(cv2.CAP_PROP_FRAME_COUNT)) // FRAMES_OF_A_CLIP)
    number = 0
    while clip.grab():
        if number % step == 0:
            good, frame = clip.retrieve()
            if good:
                yield np.ascontiguousarray(frame[..., ::-1])
        number += 1
    clip.release()


def _crops(
    picture: Picture,  # [H, W, 3]
    width: int,
    height: int,
) -> list[Picture]:
    """[height, width, 3] of the whole and, where none has to be enlarged, of its quarters, cut to
    shape; what shows open water is left out."""
    rows, columns = picture.shape[:2]
    parts = [picture]
    if rows >= 2 * height and columns >= 2 * width:
        halves = [(slice(0, n // 2), slice(n // 2, n)) for n in (rows, columns)]
        parts += [picture[r, c] for r in halves[0] for c in halves[1]]
    cuts = [_cut(part, width, height) for part in parts]
    return [cut for cut in cuts if _detail(cut) >= LEAST_DETAIL]


def _detail(
    picture: Picture,  # [H, W, 3]
) -> float:
    """Deviation of grey about its surroundings."""
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return float((grey - cv2.blur(grey, (SURROUNDINGS_PX, SURROUNDINGS_PX))).std())


def _cut(
    picture: Picture,  # [H, W, 3]
    width: int,
    height: int,
) -> Picture:
    """The largest middle part of the shape, reduced."""
    rows, columns = picture.shape[:2]
    scale = min(rows / height, columns / width)
    cut_rows, cut_columns = round(scale * height), round(scale * width)
    top, left = (rows - cut_rows) // 2, (columns - cut_columns) // 2
    middle = picture[top : top + cut_rows, left : left + cut_columns]
    resized = cv2.resize(middle, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(resized, dtype=np.uint8)
