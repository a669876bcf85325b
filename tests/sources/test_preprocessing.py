"""Preparation: crops, the calibration that fits them, one size for all frames of a recording."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from aquaflow.base.errors import ConfigError, InputError
from aquaflow.config import SourceConfig, parse_config
from aquaflow.geometry.camera import CameraModel, guess_camera
from aquaflow.sources.preprocessing import DEFAULT_WIDTH_PX, Preparation, crop_box, fit_calibration
from aquaflow.types import Frame

WHOLE = CameraModel(640, 240, 300.0, 300.0, 330.0, 118.0)
"""A calibration for the whole side-by-side picture."""
HALF = CameraModel(320, 240, 260.0, 261.0, 158.0, 121.0)
"""A calibration for one half of it."""


def frame(width: int = 640, height: int = 240, index: int = 0, mask: bool = False) -> Frame:
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    image = np.stack([u * 255 // width, v * 255 // height, 0 * u], -1).astype(np.uint8)
    seen = u < width // 4 if mask else None
    return Frame(index, 10, 20, image, guess_camera(width, height), mask=seen)


def prepared(picture: Frame, calibration: CameraModel | None = None, **settings: object) -> Frame:
    return Preparation(SourceConfig.model_validate(settings), calibration)(picture)


# --- crop -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("crop", "box"),
    [
        (None, (0, 0, 641, 240)),
        ("left", (0, 0, 320, 240)),
        ("right", (321, 0, 320, 240)),
        ("10,20,300,200", (10, 20, 300, 200)),
        (" 0, 0, 641, 240 ", (0, 0, 641, 240)),
    ],
)
def test_a_crop_is_a_box(crop: str | None, box: tuple[int, int, int, int]) -> None:
    assert crop_box(crop, 641, 240) == box


@pytest.mark.parametrize(
    "crop",
    [
        *("middle", "", "1,2,3", "1,2,3,4,5", "1,2,3,x", "0,0,1.5,2"),
        *("-1,0,10,10", "0,-1,10,10", "0,0,0,10", "0,0,10,0"),
    ],
)
def test_a_crop_that_is_no_box_is_refused(crop: str) -> None:
    with pytest.raises(ConfigError, match="is neither left, right nor x,y,width,height"):
        parse_config({"source": {"crop": crop}}, "a config")


@pytest.mark.parametrize("crop", ["631,0,10,10", "0,231,10,10"])
def test_a_crop_outside_the_picture_is_refused(crop: str) -> None:
    with pytest.raises(ConfigError, match="reaches outside the 640 x 240 picture"):
        crop_box(crop, 640, 240)


@pytest.mark.parametrize(("crop", "first_red"), [("left", 0), ("right", 127)])
def test_the_crop_keeps_its_part_of_the_picture(crop: str, first_red: int) -> None:
    result = prepared(frame(), crop=crop)
    assert result.image.shape == (240, 320, 3)
    assert result.image[0, 0, 0] == pytest.approx(first_red, abs=1)


# --- calibration ----------------------------------------------------------------------------------


def test_a_calibration_of_the_whole_picture_is_cropped() -> None:
    camera = fit_calibration(WHOLE, (640, 240), (320, 0, 320, 240))
    assert camera == WHOLE.crop(320, 0, 320, 240)


def test_a_calibration_of_the_crop_is_taken_as_it_is() -> None:
    assert fit_calibration(HALF, (640, 240), (320, 0, 320, 240)) == HALF


def test_a_calibration_at_another_resolution_is_scaled() -> None:
    half = fit_calibration(HALF.resize(1280, 960), (640, 240), (0, 0, 320, 240))
    whole = fit_calibration(WHOLE.resize(1280, 480), (640, 240), (320, 0, 320, 240))
    assert half == HALF
    assert whole == WHOLE.crop(320, 0, 320, 240)


def test_a_rounded_height_still_fits() -> None:
    assert fit_calibration(HALF, (1280, 957), (0, 0, 1280, 957)).height == 957


def test_without_a_calibration_the_focal_length_is_guessed() -> None:
    assert fit_calibration(None, (640, 240), (0, 0, 320, 240)) == guess_camera(320, 240)


def test_a_calibration_of_another_shape_is_refused_in_one_sentence() -> None:
    with pytest.raises(ConfigError) as caught:
        fit_calibration(CameraModel(400, 400, 1, 1, 0, 0), (640, 240), (0, 0, 320, 240))
    assert str(caught.value) == (
        "the calibration is for 400 x 400 pictures, these are 320 x 240; "
        "calibrate at this shape or choose the --crop that it was made for"
    )


# --- masks ----------------------------------------------------------------------------------------


def mask_file(folder: Path, width: int, height: int) -> Path:
    """White but for its left quarter."""
    path = folder / "mask.png"
    picture = np.full((height, width), 255, np.uint8)
    picture[:, : width // 4] = 0
    cv2.imwrite(str(path), picture)
    return path


def test_a_mask_of_the_picture_s_size_is_prepared_with_the_picture(tmp_path: Path) -> None:
    result = prepared(frame(), mask=mask_file(tmp_path, 640, 240), width=320)
    assert result.mask is not None
    assert result.mask.shape == (120, 320)
    assert not result.mask[:, :78].any()
    assert result.mask[:, 82:].all()


@pytest.mark.parametrize(("width", "left"), [(640, 160), (320, 80)])
def test_a_mask_is_of_the_whole_picture_or_of_the_crop(
    width: int, left: int, tmp_path: Path
) -> None:
    result = prepared(frame(), mask=mask_file(tmp_path, width, 240), crop="left")
    assert result.mask is not None
    np.testing.assert_array_equal(result.mask.any(axis=0), np.arange(320) >= left)


def test_a_mask_of_the_frame_is_limited_by_the_one_given(tmp_path: Path) -> None:
    picture = frame(mask=True)
    result = prepared(picture, mask=mask_file(tmp_path, 640, 240))
    assert result.mask is not None
    assert picture.mask is not None
    assert not result.mask.any(), "the frame shows the scene only where the file is black"


def test_a_mask_of_another_size_is_refused_in_one_sentence(tmp_path: Path) -> None:
    path = mask_file(tmp_path, 100, 80)
    with pytest.raises(ConfigError) as caught:
        prepared(frame(), mask=path)
    assert str(caught.value) == (
        f"the mask {path} is 100 x 80, the pictures are 640 x 240; make it of their size"
    )


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "cannot read"),
        (b"", "is no picture"),
        (b"white", "is no picture"),
        ("black", "black"),
    ],
)
def test_a_file_that_is_no_mask_is_refused(
    content: bytes | str | None, says: str, tmp_path: Path
) -> None:
    path = tmp_path / "mask.png"
    if content == "black":
        cv2.imwrite(str(path), np.zeros((240, 640), np.uint8))
    elif isinstance(content, bytes):
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=says):
        prepared(frame(), mask=path)


# --- frames ---------------------------------------------------------------------------------------


def test_the_default_width_shrinks_and_never_enlarges() -> None:
    assert prepared(frame(960, 720)).image.shape == (360, DEFAULT_WIDTH_PX, 3)
    assert prepared(frame(320, 240)).image.shape == (240, 320, 3)


def test_the_asked_width_is_made_and_the_camera_fits_the_picture() -> None:
    result = prepared(frame(), HALF, crop="left", width=160)
    assert result.image.shape == (120, 160, 3)
    assert result.camera == HALF.resize(160, 120)


def test_everything_but_picture_camera_and_mask_is_kept() -> None:
    before = frame(index=7)
    after = prepared(before)
    assert (after.index, after.t_ns, after.arrival_ns) == (7, 10, 20)
    assert after.mask is None


def test_the_mask_goes_the_way_of_the_picture() -> None:
    mask = prepared(frame(mask=True), crop="left", width=160).mask
    assert mask is not None
    assert mask.shape == (120, 160)
    np.testing.assert_array_equal(mask[60], np.arange(160) < 80)


def test_a_distorted_camera_comes_out_pinhole() -> None:
    bent = CameraModel(
        320,
        240,
        260.0,
        260.0,
        160.0,
        120.0,
        distortion_model="radtan",
        distortion=(-0.2, 0.0, 0.0, 0.0),
    )
    result = prepared(frame(320, 240), bent)
    assert not result.camera.is_distorted
    assert result.camera.fx != bent.fx


def test_the_camera_is_known_once_a_frame_was_seen() -> None:
    preparation = Preparation(SourceConfig(), HALF)
    assert preparation.camera is None
    result = preparation(frame(320, 240))
    assert preparation.camera == result.camera


def test_a_frame_of_another_size_is_refused_and_the_next_goes_on() -> None:
    preparation = Preparation(SourceConfig(), None)
    preparation(frame(320, 240))
    with pytest.raises(InputError) as caught:
        preparation(frame(322, 240, index=3))
    assert str(caught.value) == (
        "frame 3 is 322 x 240, the recording is 320 x 240; "
        "frames of one recording must be of one size"
    )
    assert preparation(frame(320, 240, index=4)).index == 4


def test_a_crop_that_does_not_fit_stops_at_the_first_frame() -> None:
    with pytest.raises(ConfigError, match="reaches outside"):
        prepared(frame(), crop="0,0,900,240")
