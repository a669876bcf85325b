"""Pairs from the user's pictures: of one size, with exact matches, and without open water."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from aquaflow.base.errors import InputError
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pair_generator.real_pictures import FRAMES_OF_A_CLIP, RealPictures
from aquaflow.lab.training.pairs import correspondences

pytestmark = pytest.mark.usefixtures("one_thread")

WIDTH, HEIGHT = 64, 48


def textured(rows: int, columns: int, seed: int = 0) -> np.ndarray:
    """[rows, columns, 3] of smooth noise."""
    noise = np.random.default_rng(seed).integers(0, 255, (rows // 4, columns // 4, 3), np.uint8)
    return cv2.resize(noise, (columns, rows), interpolation=cv2.INTER_CUBIC)


def test_large_pictures_give_quarters_too_and_open_water_nothing(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "large.png"), textured(HEIGHT * 2, WIDTH * 2))
    cv2.imwrite(str(tmp_path / "small.png"), textured(HEIGHT, WIDTH))
    cv2.imwrite(str(tmp_path / "water.png"), np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    (tmp_path / "broken.png").write_bytes(b"no picture")
    pictures = RealPictures([tmp_path], WIDTH, HEIGHT)
    assert pictures.images.shape == (6, 3, HEIGHT, WIDTH)


def test_colours_are_red_green_blue(tmp_path: Path) -> None:
    picture = textured(HEIGHT, WIDTH)
    picture[..., 2] = 250  # red, as OpenCV orders channels
    cv2.imwrite(str(tmp_path / "red.png"), picture)
    red, _, blue = RealPictures([tmp_path], WIDTH, HEIGHT).images[0].float().mean(dim=(1, 2))
    assert float(red) > 240.0
    assert float(blue) < 200.0


def test_a_clip_gives_frames_evenly(tmp_path: Path) -> None:
    path = str(tmp_path / "clip.avi")
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (WIDTH, HEIGHT))
    frames = 2 * FRAMES_OF_A_CLIP
    for number in range(frames):
        writer.write(textured(HEIGHT, WIDTH, number))
    writer.release()
    assert len(RealPictures([tmp_path], WIDTH, HEIGHT).images) == FRAMES_OF_A_CLIP


def test_matches_show_the_same_place(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "large.png"), textured(HEIGHT * 4, WIDTH * 4))
    pair = RealPictures([tmp_path], WIDTH, HEIGHT).pairs(Draw(1), 4)
    found = correspondences(pair)
    grid = found.pixels / torch.tensor([WIDTH, HEIGHT]) * 2.0 - 1.0
    seen = torch.nn.functional.grid_sample(pair.b.image, grid, align_corners=False)
    error = (seen - pair.a.image).abs().mean(1)
    assert float(found.visible.float().mean()) > 0.3
    assert float(error[found.visible].median()) < 0.05
    assert not torch.equal(pair.a.T_wc, pair.b.T_wc)


def test_a_folder_without_pictures_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is no folder"):
        RealPictures([tmp_path / "missing"], WIDTH, HEIGHT)
    with pytest.raises(InputError, match="holds no textured picture"):
        RealPictures([tmp_path], WIDTH, HEIGHT)
