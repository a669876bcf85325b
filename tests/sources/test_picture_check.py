"""What is odd about pictures is said; usual ones are left alone."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.sources.picture_check import oddities

Pictures = list[npt.NDArray[np.uint8]]
rng = np.random.default_rng(0)
SCENE = np.kron(rng.integers(60, 190, (20, 40, 3)), np.ones((16, 16, 1))).astype(np.uint8)
OTHER = np.kron(rng.integers(60, 190, (20, 40, 3)), np.ones((16, 16, 1))).astype(np.uint8)


def moving(scene: npt.NDArray[np.uint8], count: int = 10) -> Pictures:
    return [scene[:, 2 * n : 2 * n + 480].copy() for n in range(count)]


def test_usual_pictures_are_not_odd() -> None:
    assert oddities(moving(SCENE)) == []


@pytest.mark.parametrize(
    ("pictures", "words"),
    [
        ([np.full((96, 96, 3), 90, np.uint8)] * 5, "5 of 5 pictures are of one colour"),
        ([np.full((96, 96, 3), 3, np.uint8)] * 5, "nearly black"),
        ([np.full((96, 96, 3), 252, np.uint8)] * 5, "nearly white"),
        ([SCENE] * 5, "nothing moves"),
        ([each for each in moving(SCENE) for _ in range(3)], "repeat the one before"),
        (moving(SCENE) + moving(OTHER), "changes from one picture to the next once"),
    ],
)
def test_what_is_odd_is_named(pictures: Pictures, words: str) -> None:
    assert words in "; ".join(oddities(pictures))
