"""A picture in a network's frame of another shape: whole, not stretched, and found again."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.prior.depth_describer import GREY, ImagePadding

CELL = 8


@pytest.mark.parametrize(
    ("shape", "frame", "inner"),
    [
        ((270, 480), (384, 512), (288, 512)),  # bands above and below
        ((480, 270), (384, 512), (384, 216)),  # and at the sides
        ((240, 320), (384, 512), (384, 512)),
        ((7, 4000), (384, 512), (8, 512)),  # at least a cell
    ],
)
def test_a_picture_is_as_large_as_fits_in_whole_cells(
    shape: tuple[int, int], frame: tuple[int, int], inner: tuple[int, int]
) -> None:
    framing = ImagePadding.of(*shape, frame, CELL)
    assert (framing.height, framing.width) == inner
    assert framing.top % CELL == framing.left % CELL == 0
    image = np.full((*shape, 3), 200, np.uint8)
    framed = framing.frame(image)
    assert framed.shape == (*frame, 3)
    assert ((framed == 200).all(-1).sum(), (framed == GREY).all(-1).sum()) == (
        inner[0] * inner[1],
        frame[0] * frame[1] - inner[0] * inner[1],
    )


@pytest.mark.parametrize("scale", [1, 2, 8])
def test_what_shows_the_picture_is_cut_out_at_any_resolution(scale: int) -> None:
    framing = ImagePadding.of(270, 480, (384, 512), CELL)
    framed = framing.frame(np.full((270, 480, 3), 200, np.uint8))[..., 0]
    cut = framing.cut(framed[scale // 2 :: scale, scale // 2 :: scale])
    assert cut.shape == (framing.height // scale, framing.width // scale)
    assert (cut == 200).all()
