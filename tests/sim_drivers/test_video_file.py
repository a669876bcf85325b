"""A video file as a camera: times, skipping, and videos that are damaged or none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.geometry.camera import guess_camera, save_camera
from aquaflow.recordings import video
from aquaflow.recordings.picture import UnreadablePictureError
from aquaflow.recordings.video import VideoFile
from aquaflow.recordings.video_decoder import VideoDecoder
from aquaflow.types import Dropped

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"

W, H, COUNT, FPS = 64, 48, 30, 20.0


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """30 frames of noise whose left half has the brightness 8 x index."""
    import cv2

    path = tmp_path_factory.mktemp("video") / "clip.avi"
    rng = np.random.default_rng(0)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), FPS, (W, H))
    for index in range(COUNT):
        picture = rng.integers(0, 255, (H, W, 3), dtype=np.uint8)
        picture[:, : W // 2] = 8 * index
        writer.write(picture)
    writer.release()
    return path


def brightness(frame) -> float:
    return float(frame.image[8:-8, 4:24].mean())


def test_frames_carry_container_times_names_and_content(clip):
    source = VideoFile.open(clip)
    frames = list(source.frames())

    assert source.frame_count == COUNT
    assert (source.width, source.height) == (W, H)
    assert [frame.t_ns for frame in frames] == [50_000_000 * i for i in range(COUNT)]
    assert [round(brightness(frame) / 8) for frame in frames] == list(range(COUNT))
    assert all(frame.arrival_ns == frame.t_ns for frame in frames)
    assert source.name_of(7) == "clip.avi#7"
    assert source.notes == ["rate: 20 pictures a second, from the container"]
    source.close()


def test_skipped_frames_change_neither_times_nor_pictures(clip):
    source = VideoFile(clip)
    every = {frame.index: frame for frame in source.frames()}
    some = list(source.frames(every=7, start=3, stop=20))

    assert [frame.index for frame in some] == [3, 10, 17]
    for frame in some:
        assert frame.t_ns == every[frame.index].t_ns
        np.testing.assert_array_equal(frame.image, every[frame.index].image)


def test_pictures_are_rgb(tmp_path):
    import cv2

    path = tmp_path / "red.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), FPS, (W, H))
    writer.write(np.full((H, W, 3), (0, 0, 255), np.uint8))
    writer.release()
    (frame,) = VideoFile(path).frames()

    assert frame.image[..., 0].min() > 240
    assert frame.image[..., 2].max() < 15


def test_cut_off_video_is_read_to_its_break_with_one_note(clip, tmp_path, capfd):
    cut = tmp_path / "cut.avi"
    content = clip.read_bytes()
    cut.write_bytes(content[: len(content) * 2 // 3])
    source = VideoFile(cut)

    for _ in range(2):
        read = len(list(source.frames()))
        assert 10 < read < COUNT
        assert source.notes[1:] == [f"the video ends after {read} of {COUNT} frames"]
    assert capfd.readouterr() == ("", "")


def test_reading_only_the_beginning_is_no_early_end(clip, tmp_path):
    source = VideoFile(clip)

    assert len(list(source.frames(stop=5))) == 5
    assert source.notes == ["rate: 20 pictures a second, from the container"]


@pytest.mark.parametrize("name", ["notes.mp4", "notes.avi", "empty.mkv"])
def test_text_named_like_a_video_is_one_sentence_and_silent(tmp_path, capfd, name):
    path = tmp_path / name
    path.write_text("" if name.startswith("empty") else "hello\n" * 100)

    assert VideoFile.recognises(path)
    with pytest.raises(InputError, match="cannot be read as a video; check that it plays"):
        VideoFile(path)
    assert capfd.readouterr() == ("", "")


def test_videos_are_recognised_by_extension(tmp_path):
    for name in ("a.MP4", "a.mov", "a.webm"):
        (tmp_path / name).touch()
        assert VideoFile.recognises(tmp_path / name)
    (tmp_path / "a.txt").touch()
    assert not VideoFile.recognises(tmp_path / "a.txt")
    assert not VideoFile.recognises(tmp_path)


def test_times_that_do_not_increase_are_set_from_the_frame_rate():
    clock = video._Clock(period_ns=50e6)

    times = [clock.tick(ms) for ms in (10.0, 60.0, 60.0, 0.0, 400.0)]

    assert times == [0, 50_000_000, 100_000_000, 150_000_000, 390_000_000]
    assert clock.repaired == 2


def test_repaired_times_are_noted(clip, monkeypatch):
    monkeypatch.setattr(VideoDecoder, "position_ms", 0.0)
    source = VideoFile.open(clip, fps=10.0)
    times = [frame.t_ns for frame in source.frames(stop=3)]

    assert times == [0, 100_000_000, 200_000_000]
    assert source.notes[1:] == [
        "2 frame times of clip.avi do not increase; they were set from the frame rate"
    ]


def test_frame_that_cannot_be_decoded_is_dropped():
    class Broken:
        def picture(self):
            raise UnreadablePictureError("cannot be decoded")

    source = VideoFile.__new__(VideoFile)
    source.path = Path("clip.mp4")

    assert source._frame(Broken(), 3, 5) == Dropped(3, 5, "clip.mp4#3 cannot be decoded")


def test_calibration_beside_the_video_is_used_if_its_shape_fits(clip):
    calibration = clip.parent / "camera.yaml"
    try:
        save_camera(guess_camera(2 * W, 2 * H), calibration)
        source = VideoFile(clip)
        assert source.camera.width == 2 * W
        list(source.frames())
        assert source.notes[1:] == [f"the calibration is {calibration}"]
        save_camera(guess_camera(W, W), calibration)
        assert VideoFile(clip).camera is None
    finally:
        calibration.unlink()
    (frame,) = VideoFile(clip).frames(stop=1)
    assert frame.camera == guess_camera(W, H)


@pytest.mark.skipif(not DATA.is_dir(), reason=f"the real data are not at {DATA}")
def test_real_clip_has_the_times_of_its_truth():
    source = VideoFile(DATA / "reef_clip" / "reef_clip.mp4")
    frames = list(source.frames(every=4, stop=13))
    truth = np.loadtxt(DATA / "reef_clip" / "poses_sfm.tum")[: len(frames), 0]

    assert source.frame_count == 211
    np.testing.assert_allclose([frame.t_ns / 1e9 for frame in frames], truth, atol=2e-3)
    assert frames[0].image.shape == (1080, 1920, 3)


def test_what_a_container_does_not_know_counts_as_unknown(clip):
    class Unsure:
        def get(self, number):
            return float("nan")

    decoder = VideoDecoder(clip)
    decoder._capture = Unsure()
    assert decoder._property(7) == 0.0
