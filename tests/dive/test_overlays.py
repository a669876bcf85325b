"""A burned-in display in a whole dive: found, said, and masked in what is tracked and mapped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aquaflow.config import Config, parse_config
from aquaflow.dive import calibration_pass
from aquaflow.dive.replay import map_recording
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.dive import write_dive
from aquaflow.slam import Slam
from aquaflow.sources import open_recording
from aquaflow.tracking.lens_equations import LensView
from aquaflow.tracking.overlay import OverlayFinder
from aquaflow.tracking.self_calibration import FoundLens
from aquaflow.types import Frame
from tests.slam_scenes import ToldTracker, frame_of

FRAMES = 12


def pool_dive(out: Path, **other: float) -> Path:
    small = {"frames": FRAMES, "width": 240, "height": 180, "supersampling": 1}
    shown = {"scene": "pool", "display": "clock_and_crosshair"}
    write_dive(out, SyntheticConfig.model_validate({**small, **shown, **other}))
    return out


@pytest.fixture(scope="module")
def pool(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return pool_dive(tmp_path_factory.mktemp("dives") / "pool", speed_m_s=1.0)


@pytest.fixture(scope="module")
def slow_pool(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """In which tracking needs no calibration."""
    return pool_dive(tmp_path_factory.mktemp("dives") / "slow_pool")


def settings(mask_overlays: bool = True) -> Config:
    tracking = {
        "mask_overlays": mask_overlays,
        "gate": {"skip_duplicates": False},
        "initialisation": {"focal_factors": [1.4]},  # one start instead of three
    }
    return parse_config({"threads": 1, "tracking": tracking, "mapping": {"enabled": False}}, "test")


def test_the_notes_say_that_an_overlay_was_found_and_how_large_it_is(
    pool: Path, tmp_path: Path
) -> None:
    finished = map_recording(open_recording(pool), "pool", tmp_path / "dive", settings())
    [note] = [note for note in finished.notes if "overlay" in note]
    assert note.startswith("an overlay of ")
    assert note.endswith(" % of the picture was found and masked")
    assert 2.0 < float(note.split()[3]) < 16.0


def masks_seen(pool: Path, config: Config) -> list[bool]:
    """Whether the tracker got a mask, for every frame."""
    slam, recording = Slam(config), open_recording(pool)
    slam.tracker = ToldTracker(slam, "K" + "C" * FRAMES)  # type: ignore[assignment]
    tracked = []
    for frame in recording.frames():
        assert isinstance(frame, Frame)
        tracked += slam.process(frame)
    recording.close()
    slam.close()
    return [each.frame.mask is not None for each in tracked]


def test_the_tracker_gets_the_frames_with_the_overlay_masked(pool: Path) -> None:
    masked = masks_seen(pool, settings())
    assert not masked[0]
    assert all(masked[FRAMES // 2 :])


def test_overlays_are_not_looked_for_where_that_is_switched_off(pool: Path) -> None:
    assert not any(masks_seen(pool, settings(mask_overlays=False)))


def keypoints_of_the_lens(
    pool: Path, config: Config, monkeypatch: pytest.MonkeyPatch
) -> tuple[np.ndarray, np.ndarray]:
    """[M, 2] those that the lens is found from, and [H, W] what is no overlay."""
    pixels, shown = [], []

    def spy(views: list[LensView], start: object) -> FoundLens:
        pixels.extend(view.keypoints.pixels for view in views)
        return FoundLens(np.zeros(5), np.full(2, 0.02), 3e-4, len(views), len(pixels))

    def keep(finder: OverlayFinder, frame: Frame) -> Frame:
        masked = find(finder, frame)
        shown.append(finder.shown)
        return masked

    find = OverlayFinder.mask
    monkeypatch.setattr(OverlayFinder, "mask", keep)
    monkeypatch.setattr(calibration_pass, "found_lens", spy)
    # One pass that poses a part of the frames is enough.
    monkeypatch.setattr(calibration_pass, "REPEAT_OUTSIDE_SHARE", 1.0)
    recording = open_recording(pool / "images")
    calibration_pass.found_in(recording, config, lambda done, of: None)
    recording.close()
    seen = [each for each in shown if each is not None]
    return np.concatenate(pixels), seen[-1] if seen else np.ones((180, 240), bool)


def test_the_lens_is_found_from_the_scene_and_not_from_the_display(
    slow_pool: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What stands still in the picture says that the camera does; the first pictures were taken
    before the display was found, and have keypoints on it."""
    with monkeypatch.context() as patch:
        pixels, shown = keypoints_of_the_lens(slow_pool, settings(), patch)
    column, row = np.floor(pixels).astype(int).T
    assert not shown.all()
    assert shown[row, column].all()
    pixels, _ = keypoints_of_the_lens(slow_pool, settings(mask_overlays=False), monkeypatch)
    column, row = np.floor(pixels).astype(int).T
    assert (~shown[row, column]).any()


@pytest.mark.usefixtures("contained")
def test_a_finder_that_fails_costs_no_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    slam = Slam(settings())
    slam.tracker = ToldTracker(slam, "KC")  # type: ignore[assignment]

    def fail(frame: Frame) -> Frame:
        raise ValueError("no overlay")

    monkeypatch.setattr(slam.overlays, "mask", fail)
    tracked = [each for k in range(2) for each in slam.process(frame_of(k))]
    slam.close()
    assert [each.frame.index for each in tracked] == [0, 1]
    assert all(np.isfinite(each.T_wc.t).all() for each in tracked if each.T_wc is not None)
