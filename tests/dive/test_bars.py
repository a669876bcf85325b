"""The bars of the first release on whole recordings: minutes each, run by ``make test-all``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.command_line import Cli

pytestmark = pytest.mark.slow

Values = dict[str, Any]


def mapped(aquaflow: Cli, dive: Path, *arguments: object) -> Values:
    ran = aquaflow("map", *arguments, "--out", dive, "--json", timeout_s=900.0)
    assert ran.code == 0, ran.err
    return dict(json.loads(ran.out))


def evaluated(aquaflow: Cli, dive: Path, *arguments: object) -> Values:
    ran = aquaflow("lab", "evaluate", dive, *arguments, "--json")
    assert ran.code == 0, ran.err
    return dict(json.loads(ran.out))


def test_reef_clip(aquaflow: Cli, shared_data: Path, tmp_path: Path) -> None:
    clip, dive = shared_data / "reef_clip", tmp_path / "dive"
    calibration = ("--calib", clip / "camera.yaml")
    options = (*calibration, "--every", 2, "--width", 480)
    metrics = mapped(aquaflow, dive, clip / "reef_clip.mp4", *options)
    result = evaluated(aquaflow, dive, "--truth", clip / "poses_sfm.tum")
    assert result["posed_fraction"] >= 0.95
    assert result["sub_maps"] == 1
    assert result["ate_pct_sim3"] <= 0.6
    assert metrics["psnr"] >= 25.0


def test_curasao_is_mapped_and_its_water_removed(
    aquaflow: Cli, shared_data: Path, tmp_path: Path
) -> None:
    folder, dive = shared_data / "curasao", tmp_path / "dive"
    video = folder / "clip_side_by_side.mp4"
    calibration = ("--calib", folder / "camera.yaml")
    metrics = mapped(aquaflow, dive, video, *calibration, "--crop", "left", "--every", 8)
    clean = ("--clean", video, "--clean-crop", "right")
    result = evaluated(aquaflow, dive, "--truth", folder / "poses_sfm.tum", *clean)
    assert result["posed_fraction"] >= 0.95
    assert result["ate_pct_sim3"] <= 0.5
    assert metrics["psnr"] >= 30.0
    assert result["restoration"]["gain_db"] > 0.0


def test_survey_stills(aquaflow: Cli, shared_data: Path, tmp_path: Path) -> None:
    survey, dive = shared_data / "auv_survey_1", tmp_path / "dive"
    mapped(aquaflow, dive, survey)
    result = evaluated(aquaflow, dive, "--truth", survey / "positions_geotiff.csv")
    assert result["posed"] == 8
    assert result["ate_pct_sim3"] <= 3.0


def test_synthetic_dive(aquaflow: Cli, tmp_path: Path) -> None:
    truth, dive = tmp_path / "truth", tmp_path / "dive"
    assert aquaflow("lab", "synth", truth).code == 0
    mapped(aquaflow, dive, truth)
    result = evaluated(aquaflow, dive, "--truth", truth, "--clean", truth)
    assert result["ate_pct_sim3"] <= 0.5
    for ratio in result["medium_error"]["attenuation_ratio"]:
        assert 0.75 <= ratio <= 1.25
    assert result["restoration"]["gain_db"] > 0.0
