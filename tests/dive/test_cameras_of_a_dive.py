"""Dives through a flat port and with a fisheye lens, from file to evaluation."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from aquaflow.config import Config
from aquaflow.dive.replay import map_recording
from aquaflow.geometry.camera import load_camera
from aquaflow.geometry.port import FlatPort
from aquaflow.lab.evaluation.protocol import evaluate_dive
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.dive import write_dive
from aquaflow.sources import open_recording

SMALL = {"frames": 16, "width": 160, "height": 120, "supersampling": 1, "speed_m_s": 0.4}
HASTY = yaml.safe_load((Path(__file__).parents[1] / "hasty.yaml").read_text())
MOST_ATE_PCT = 2.0
"""Of the path, at 160 px; a camera that is read wrongly has more than 5."""


def recorded(out: Path, changes: dict[str, object]) -> Path:
    write_dive(out, SyntheticConfig.model_validate(SMALL | changes))
    return out


@pytest.fixture(scope="module")
def behind_glass(tmp_path_factory: pytest.TempPathFactory) -> Path:
    port = {"kind": "flat", "distance_m": 0.05, "thickness_m": 0.01}
    out = tmp_path_factory.mktemp("port") / "recording"
    return recorded(out, {"port": port, "focal_widths": 0.77})


def test_a_dive_behind_a_flat_port_uses_it_and_says_so(behind_glass: Path, tmp_path: Path) -> None:
    config = Config.model_validate({"threads": 1, "mapping": {"enabled": False}})
    dive = tmp_path / "dive"
    finished = map_recording(open_recording(behind_glass), "port", dive, config)

    assert evaluate_dive(dive, behind_glass).error.sim3.pct < MOST_ATE_PCT
    (note,) = [each for each in finished.notes if "flat port" in each]
    assert "0.05 m before 0.01 m of glass, water of index 1.3417), exactly at 1 m" in note
    assert note in (dive / "report.html").read_text()
    assert load_camera(dive / "calibration.yaml").port == FlatPort(0.05, 0.01)
    mapped = load_camera(dive / "camera.yaml")
    assert mapped.is_pinhole
    # 66 degrees in air are 48 in water, of which a rectangle of 46 is whole.
    assert mapped.fx / mapped.width == pytest.approx(1.17, abs=0.01)


def test_a_fisheye_is_mapped_from_its_file_to_the_evaluation(tmp_path: Path) -> None:
    source = recorded(tmp_path / "recording", {"lens": "fisheye", "focal_widths": 0.44})
    assert load_camera(source / "camera.yaml").distortion_model == "fisheye"
    dive = tmp_path / "dive"
    config = Config.model_validate({"threads": 1} | HASTY)
    finished = map_recording(open_recording(source), "fisheye", dive, config)

    assert finished.metrics["tracked"] == SMALL["frames"]
    assert finished.metrics["psnr"] > 15.0
    assert evaluate_dive(dive, source).error.sim3.pct < MOST_ATE_PCT
    mapped = load_camera(dive / "camera.yaml")
    assert mapped.is_pinhole
    assert load_camera(dive / "calibration.yaml") == load_camera(source / "camera.yaml")
