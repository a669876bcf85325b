"""A folder of pictures as a camera: order, times, formats, and what is left out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from aquaflow.base.errors import ArgumentError, ConfigError, InputError
from aquaflow.geometry.camera import guess_camera, save_camera
from aquaflow.recordings.images import ImageFolder
from aquaflow.recordings.synthetic import SyntheticDive
from aquaflow.sources import open_recording
from aquaflow.types import Dropped, Frame

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"

W, H = 16, 12


def rgb(value: int = 0, size: tuple[int, int] = (W, H)) -> np.ndarray:
    return np.full((size[1], size[0], 3), value, np.uint8)


def save(path: Path, array: np.ndarray) -> Path:
    Image.fromarray(array).save(path)
    return path


@pytest.fixture
def folder(tmp_path):
    """1.png, 2.png, 10.png with values 1, 2, 10."""
    for value in (10, 2, 1):
        save(tmp_path / f"{value}.png", rgb(value))
    return tmp_path


def values(source: ImageFolder, **span: int) -> list[int]:
    return [
        int(frame.image[0, 0, 0]) for frame in source.frames(**span) if isinstance(frame, Frame)
    ]


def test_pictures_come_in_natural_order_with_names_and_times(folder):
    source = ImageFolder.open(folder, fps=4.0)
    frames = list(source.frames())

    assert source.frame_count == 3
    assert values(source) == [1, 2, 10]
    assert [source.name_of(i) for i in range(3)] == ["1.png", "2.png", "10.png"]
    assert [frame.t_ns for frame in frames] == [0, 250_000_000, 500_000_000]
    assert all(frame.arrival_ns == frame.t_ns for frame in frames)
    assert source.notes == ["the pictures have the 4 a second that were given"]


def test_sub_sampling_keeps_index_and_time_of_the_folder(folder):
    frames = list(ImageFolder(folder).frames(every=2, start=0, stop=99))

    assert [(frame.index, frame.t_ns) for frame in frames] == [(0, 0), (2, 200_000_000)]
    assert values(ImageFolder(folder), start=1, stop=2) == [2]


@pytest.mark.parametrize("suffix", ["JPG", "jpeg", "tif", "TIFF", "bmp", "webp", "ppm"])
def test_every_usual_format_is_read_whatever_the_case(tmp_path, suffix):
    save(tmp_path / f"a.{suffix}", rgb(100))

    assert abs(values(ImageFolder(tmp_path))[0] - 100) <= 2


@pytest.mark.parametrize(
    "array",
    [
        np.full((H, W), 200, np.uint8),
        np.full((H, W, 4), 200, np.uint8),
        np.full((H, W), 200 * 256 + 7, np.uint16),
    ],
    ids=["grey", "alpha", "grey16"],
)
def test_grey_alpha_and_sixteen_bits_become_rgb(tmp_path, array):
    save(tmp_path / "a.png", array)
    (frame,) = ImageFolder(tmp_path).frames()

    assert frame.image.shape == (H, W, 3)
    assert frame.image.dtype == np.uint8
    assert (frame.image == 200).all()


def test_twelve_bits_in_sixteen_keep_one_brightness_over_the_folder(tmp_path):
    save(tmp_path / "1.png", np.full((H, W), 4000, np.uint16))
    save(tmp_path / "2.png", np.full((H, W), 400, np.uint16))

    assert values(ImageFolder(tmp_path)) == [250, 25]
    assert values(ImageFolder(tmp_path), start=1) == [25]


def test_sixteen_bit_colour_keeps_its_high_byte(tmp_path):
    import cv2

    cv2.imwrite(str(tmp_path / "a.png"), np.full((H, W, 3), 77 * 256 + 200, np.uint16))

    assert values(ImageFolder(tmp_path)) == [77]


def test_size_of_most_pictures_wins_and_others_are_dropped_with_a_reason(folder):
    save(folder / "3.png", rgb(3, (8, 8)))
    source = ImageFolder(folder)
    third = list(source.frames())[2]

    assert isinstance(third, Dropped)
    assert (third.index, third.t_ns) == (2, 200_000_000)
    assert third.reason == "3.png is 8 x 8 while most pictures are 16 x 12"
    assert source.notes[1:] == [f"1 of 4 pictures were left out; the first: {third.reason}"]
    assert (source.width, source.height) == (W, H)


def test_unreadable_and_cut_off_pictures_are_dropped_silently(folder, capfd, recwarn):
    (folder / "4.png").write_bytes(b"no picture")
    noise = np.random.default_rng(0).integers(0, 255, (H, W, 3), dtype=np.uint8)
    whole = save(folder / "5.jpg", noise).read_bytes()
    (folder / "5.jpg").write_bytes(whole[:-100])
    source = ImageFolder(folder)
    reasons = [item.reason for item in source.frames() if isinstance(item, Dropped)]

    assert reasons == ["4.png cannot be read as a picture", "5.jpg is damaged or cut off"]
    assert source.notes[1].startswith("2 of 5 pictures were left out")
    assert capfd.readouterr() == ("", "")
    assert not recwarn.list


def test_float_pictures_are_dropped_with_advice(folder):
    save(folder / "0.tif", np.zeros((H, W), np.float32))
    first = next(iter(ImageFolder(folder).frames()))

    assert isinstance(first, Dropped)
    assert "convert it to 8 bits" in first.reason


def test_times_come_from_timestamps_and_count_from_the_first(folder):
    (folder / "timestamps.txt").write_text("# s\n100.5\n100.75\n\n102.0\n")

    frames = list(ImageFolder.open(folder, fps=99.0).frames())

    assert [frame.t_ns for frame in frames] == [0, 250_000_000, 1_500_000_000]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("1\n2\n", "holds 2 times for 3 pictures"),
        ("1\nx\n3\n", "line 2: this is not a time in seconds"),
        ("1\n1\n3\n", "line 2: the time does not come after"),
        ("1\nnan\n3\n", "line 2: the time does not come after"),
    ],
)
def test_malformed_timestamps_are_one_sentence(folder, text, sentence):
    (folder / "timestamps.txt").write_text(text)

    with pytest.raises(InputError, match=sentence):
        ImageFolder(folder)


def test_binary_timestamps_are_one_sentence(folder):
    (folder / "timestamps.txt").write_bytes(b"\xff\xfe\x80")

    with pytest.raises(InputError, match="cannot read the times"):
        ImageFolder(folder)


@pytest.mark.parametrize("fps", [0.0, -1.0, float("nan")])
def test_frame_rate_must_be_above_zero(folder, fps):
    with pytest.raises(ArgumentError, match="is not above zero"):
        open_recording(folder, fps)


def test_folder_without_pictures_is_one_sentence(tmp_path):
    (tmp_path / "notes.txt").touch()
    (tmp_path / "._hidden.png").touch()

    assert ImageFolder.recognises(tmp_path)
    with pytest.raises(InputError, match="holds no picture; give a folder with"):
        ImageFolder(tmp_path)


def test_folder_of_unreadable_pictures_is_one_sentence(tmp_path):
    (tmp_path / "a.png").write_text("x")

    with pytest.raises(InputError, match=r"none of the 1 pictures .* a\.png"):
        ImageFolder(tmp_path)


def test_pictures_in_an_images_folder_are_found(tmp_path):
    (tmp_path / "images").mkdir()
    save(tmp_path / "images" / "a.png", rgb(5))

    assert values(ImageFolder(tmp_path)) == [5]


def test_calibration_in_the_folder_is_used_and_guessed_otherwise(folder):
    assert ImageFolder(folder).camera is None
    assert next(iter(ImageFolder(folder).frames())).camera == guess_camera(W, H)
    save_camera(guess_camera(W, H), folder / "camera.yaml")

    source = ImageFolder(folder)

    assert source.camera.calibrated
    assert next(iter(source.frames())).camera == source.camera


def test_malformed_calibration_is_one_sentence(folder):
    (folder / "camera.yaml").write_text("fx: 1\n")

    with pytest.raises(ConfigError, match="known keys are"):
        ImageFolder(folder)


def test_synthetic_dive_is_recognised_before_a_plain_folder(tmp_path):
    (tmp_path / "images").mkdir()
    save(tmp_path / "images" / "000.png", rgb(9))
    assert not SyntheticDive.recognises(tmp_path)
    (tmp_path / "synth.yaml").touch()

    source = SyntheticDive.open(tmp_path, fps=5.0)

    assert SyntheticDive.recognises(tmp_path)
    assert SyntheticDive.specificity > ImageFolder.specificity
    assert values(source) == [9]
    source.close()


@pytest.mark.parametrize(
    "stated",
    [
        "",
        "mounting: 3\n",
        "mounting: {camera: {pitch: 1}}\n",
        "mounting: {R_body_camera: []}\n",
        ": [",
    ],
)
def test_a_synthetic_dive_that_does_not_say_how_its_camera_is_mounted_is_still_read(
    tmp_path, stated
):
    (tmp_path / "images").mkdir()
    save(tmp_path / "images" / "000.png", rgb(9))
    (tmp_path / "synth.yaml").write_text(stated)

    source = SyntheticDive.open(tmp_path, fps=5.0)

    assert source.stated_mounting() is None
    assert values(source) == [9]


@pytest.mark.skipif(not DATA.is_dir(), reason=f"the real data are not at {DATA}")
def test_survey_geotiffs_are_read_without_a_word_on_stderr(capfd):
    source = ImageFolder(DATA / "auv_survey_1")
    frames = list(source.frames(every=4))

    assert source.frame_count == 8
    assert [frame.image.shape for frame in frames] == [(1024, 1360, 3)] * 2
    assert frames[0].image.std() > 5.0
    assert source.camera.calibrated
    assert capfd.readouterr() == ("", "")
