"""What a run amounts to, from results made by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from aquaflow.config import Config
from aquaflow.dive.held_out_example import HeldOut, Perceived
from aquaflow.dive.map_file import water_of
from aquaflow.dive.metric_outputs import water_in
from aquaflow.dive.results import (
    WaterSummary,
    largest_sub_map,
    metrics,
    moved_with,
    refined_poses,
)
from aquaflow.geometry.camera import guess_camera
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.slam import Slam
from aquaflow.tracking.frames import FrameClass, Tracked
from aquaflow.types import Dropped, Frame
from aquaflow.water.mounting import Lamp

PICTURE = np.zeros((48, 64, 3), np.uint8)


def tracked(index: int, frame_class: FrameClass, sub_map: int = 0, posed: bool = True) -> Tracked:
    frame = Frame(index, index, index, PICTURE, guess_camera(64, 48))
    pose = Sim3(np.eye(3), np.array([float(index), 0.0, 0.0])) if posed else None
    return Tracked(frame, frame_class, sub_map, 0, pose)


def held_out(psnr: float, ssim: float) -> HeldOut:
    return HeldOut(8, PICTURE, PICTURE, None, psnr, ssim, Perceived(0.1, None, 0.2))


@pytest.fixture(scope="module")
def slam() -> Slam:
    return Slam(Config.model_validate({}))


RESULTS = [
    tracked(0, FrameClass.KEYFRAME),
    tracked(1, FrameClass.COMMON),
    tracked(2, FrameClass.LOST, 0, posed=False),
    tracked(4, FrameClass.KEYFRAME, 1),
    tracked(5, FrameClass.MAPPING, 1),
    tracked(6, FrameClass.COMMON, 1),
]


def test_the_device_is_that_of_the_renderer(slam: Slam, monkeypatch: pytest.MonkeyPatch) -> None:
    assert metrics(slam, RESULTS, [], [], 1.0)["device"] == "cpu"
    monkeypatch.setattr(slam.renderer, "device", torch.device("cuda"))
    assert metrics(slam, RESULTS, [], [], 1.0)["device"] == "cuda"


def test_the_sub_map_with_most_poses_is_the_dives() -> None:
    assert largest_sub_map(RESULTS) == 1


def test_of_equal_sub_maps_the_earlier_is_the_dives() -> None:
    assert largest_sub_map(RESULTS[:-1]) == 0


def test_without_a_pose_the_first_sub_map_is_meant() -> None:
    assert largest_sub_map([RESULTS[2]]) == 0


def test_every_frame_is_counted_once(slam: Slam) -> None:
    numbers = metrics(slam, RESULTS, [Dropped(3, 3, "damaged")], [], 2.0)
    assert (numbers["frames"], numbers["tracked"], numbers["sub_maps"]) == (7, 5, 2)
    classes = ("keyframes", "mapping_frames", "common_frames", "lost", "skipped")
    assert [numbers[key] for key in classes] == [2, 1, 2, 1, 1]
    assert sum(numbers[key] for key in classes) == numbers["frames"]
    assert numbers["fps"] == 3.5


def test_quality_is_the_mean_over_held_out_frames(slam: Slam) -> None:
    numbers = metrics(slam, RESULTS, [], [held_out(20.0, 0.5), held_out(30.0, 0.7)], 1.0)
    assert (numbers["psnr"], numbers["ssim"], numbers["heldout_frames"]) == (25.0, 0.6, 2)
    assert (numbers["flip"], numbers["lpips"], numbers["lpips_alex"]) == (0.1, None, 0.2)


def test_without_held_out_frames_quality_is_null_and_not_zero(slam: Slam) -> None:
    numbers = metrics(slam, RESULTS, [], [], 1.0)
    assert numbers["psnr"] is None
    assert numbers["ssim"] is None


def test_an_lpips_that_was_not_measured_has_a_reason(
    slam: Slam, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hub = tmp_path / "hub"
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    numbers = metrics(slam, RESULTS, [], [held_out(20.0, 0.5)], 1.0)
    assert (numbers["lpips"] is None) == bool(numbers["lpips_reason"])
    assert "lpips" in numbers["lpips_reason"] or str(hub) in numbers["lpips_reason"]


def test_only_posed_frames_have_a_pose(slam: Slam) -> None:
    poses = refined_poses(slam, RESULTS)
    assert list(poses) == [0, 1, 4, 5, 6]
    assert poses[5].t[0] == 5.0


def test_a_frame_between_two_refined_ones_moves_with_both_in_the_cameras_axes() -> None:
    turned = Sim3(so3_exp(np.array([0.0, 0.0, 0.5 * np.pi])), np.array([5.0, 0.0, 0.0]), 2.0)
    tracked = {0: Sim3.identity(), 1: turned, 2: Sim3.identity()}
    up = Sim3(np.eye(3), np.array([0.2, 0.0, 0.0]))
    moved = moved_with(tracked, {0: Sim3.identity(), 2: up})
    np.testing.assert_allclose(moved[1].t, [5.0, 0.1, 0.0], atol=1e-12)  # half of it, along its x
    np.testing.assert_allclose(moved[1].R, turned.R, atol=1e-12)
    assert moved[1].scale == 2.0
    assert moved[2] is up


def test_frames_beyond_the_refined_ones_move_with_the_last() -> None:
    tracked = {index: Sim3.identity() for index in range(3)}
    aside = Sim3(so3_exp(np.array([0.0, 0.1, 0.0])), np.array([0.0, 0.3, 0.0]))
    moved = moved_with(tracked, {1: aside})
    for index in range(3):
        np.testing.assert_allclose(moved[index].R, aside.R, atol=1e-12)
        np.testing.assert_allclose(moved[index].t, aside.t, atol=1e-12)


def test_without_a_refined_frame_nothing_moves() -> None:
    tracked = {0: Sim3.identity(), 1: Sim3.identity()}
    assert moved_with(tracked, {}) == {}


def water_summary(**differs: Any) -> WaterSummary:
    """A summary of which tests look at some parts."""
    summary: dict[str, Any] = {
        "beta_a": [0.4, 0.2, 0.1],
        "b": [0.3] * 3,
        "B_inf": [0.1, 0.2, 0.3],
        "B_res": [0.0] * 3,
        "d": [1.0] * 3,
        "range_p5": 0.5,
        "range_median": 1.0,
        "range_p95": 2.0,
        "white_gain": [0.5, 1.0, 1.0],
        "white_choice": "camera",
        "chosen_gain": [1.0] * 3,
        "chosen_gain_sigma": None,
        "near_range": 0.7,
        "range_variance": (0.04, 0.01),
        "lightness_over_range": (0.8, 1.0),
        "beta_a_sigma": None,
        "shading": [0.0] * 5,
        "unevenness": [0.0] * 5,
        "lamp": None,
        "exposure": 1.0,
        "highlight_compression": 0.0,
    }
    return WaterSummary(**(summary | differs))


def test_a_summary_becomes_the_water_it_describes() -> None:
    water = water_of(water_summary())
    z = torch.tensor([1.0])
    torch.testing.assert_close(water.transmission(z)[0], torch.exp(-torch.tensor([0.4, 0.2, 0.1])))
    assert water.backscatter(z)[0, 2] == pytest.approx(0.3 * (1.0 - np.exp(-0.3)), abs=1e-6)


def test_a_lamps_range_is_in_the_unit_of_the_other_ranges() -> None:
    summary = water_summary(lamp=Lamp(share=0.7, power=2.0, range=1.5))
    scaled, z = water_in(summary, 2.0), torch.tensor([0.4, 1.5, 3.0])
    assert scaled.lamp == Lamp(share=0.7, power=2.0, range=3.0)
    seen = water_of(summary).transmission(z)
    torch.testing.assert_close(water_of(scaled).transmission(2.0 * z), seen)
