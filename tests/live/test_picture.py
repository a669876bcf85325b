"""The newest picture as a web page gets it: small, and not encoded more often than needed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from aquaflow.geometry.camera import guess_camera
from aquaflow.live.service_frontends import SPACING_S, WIDTH, NewestPicture
from aquaflow.types import Frame
from tests.live.live_scenes import Clock


def seen(index: int, width: int = 64, height: int = 48) -> Any:
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = 50 * index  # red
    frame = Frame(index, 0, 0, image, guess_camera(width, height))
    return SimpleNamespace(picture=frame)


def decoded(jpeg: bytes | None) -> Any:
    assert jpeg is not None
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)


def red(jpeg: bytes | None) -> int:
    assert jpeg is not None
    return round(
        float(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)[..., 2].mean())
    )


def test_the_newest_picture_is_encoded_twice_a_second_at_most() -> None:
    clock = Clock()
    picture = NewestPicture(clock)
    assert picture.jpeg() is None
    for index in (1, 2, 3, 4):
        picture.update(seen(index))
        assert abs(red(picture.jpeg()) - 50 * (1 if index < 4 else 4)) < 4
        clock.pass_(SPACING_S / 3 + 1e-6)
    assert picture.encoded == 2


def test_a_picture_that_is_still_the_newest_is_not_encoded_again() -> None:
    clock = Clock()
    picture = NewestPicture(clock)
    picture.update(seen(1))
    for _ in range(3):
        assert picture.jpeg() is not None
        picture.update(SimpleNamespace(picture=None))  # type: ignore[arg-type]
        clock.pass_(10.0)
    assert picture.encoded == 1


def test_a_large_picture_is_made_smaller() -> None:
    picture = NewestPicture()
    picture.update(seen(1, 1920, 1080))
    assert decoded(picture.jpeg()).shape == (360, WIDTH, 3)
