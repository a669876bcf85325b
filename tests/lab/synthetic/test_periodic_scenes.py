"""Scenes whose texture repeats: a hull of equal plates, and a net with open water behind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.dive import write_dive
from aquaflow.lab.synthetic.hull import PLATE_M, RADIUS_M, painted_plates, plated_side
from aquaflow.lab.synthetic.relief import Area
from aquaflow.lab.synthetic.truth import Truth, read_truth

TINY = {"width": 120, "height": 90, "supersampling": 1, "frames": 3}
AREA = Area(-1.0, -2.0, 0.01, (400, 320))
"""4.0 m along the hull, 3.2 m up."""


def written(out: Path, **settings: object) -> Truth:
    write_dive(out, SyntheticConfig.model_validate({**TINY, **settings}))
    return read_truth(out)


def test_weld_seams_stand_out_of_the_hull_at_equal_distances() -> None:
    height = plated_side(np.random.default_rng(0), AREA)
    columns = np.median(height, axis=0)
    smooth = np.convolve(np.pad(columns, 10, mode="edge"), np.ones(21) / 21, "valid")
    tops = np.flatnonzero(columns - smooth > 0.002) * AREA.cell + AREA.x0
    at = np.round(tops / PLATE_M[0])
    assert len(np.unique(at)) >= 4
    np.testing.assert_allclose(tops, at * PLATE_M[0], atol=0.02)


def test_a_hull_is_curved_about_a_level_axis() -> None:
    height = plated_side(np.random.default_rng(0), AREA).mean(axis=0)
    half = 0.5 * AREA.shape[1] * AREA.cell
    fall = height[150:170].mean() - 0.5 * (height[:20].mean() + height[-20:].mean())
    assert fall == pytest.approx(half**2 / (2.0 * RADIUS_M), rel=0.2)


def test_the_seams_of_the_paint_are_those_of_the_relief() -> None:
    paint = painted_plates(AREA, (800, 640), 0.005, np.random.default_rng(0)).mean(axis=-1)
    seam = paint[:, round((PLATE_M[0] - AREA.x0) / 0.005)].mean()
    beside = paint[:, round((0.5 * PLATE_M[0] - AREA.x0) / 0.005)].mean()
    assert seam < 0.7 * beside


def test_a_hull_fills_the_view_of_a_vehicle_that_faces_it(tmp_path: Path) -> None:
    truth = written(tmp_path, scene="hull")
    assert np.isfinite(truth.range_m(1)).all()
    assert np.median(truth.range_m(1)) == pytest.approx(1.3, abs=0.3)
    assert (np.abs(truth.T_wc[:, 2, 2]) < 0.5).all(), "the camera looks level, at the side"


def test_one_sees_through_a_net_to_open_water(tmp_path: Path) -> None:
    truth = written(tmp_path, scene="net", width=240, height=180)
    ranges = truth.range_m(1)
    twine = np.isfinite(ranges)
    assert 0.08 < twine.mean() < 0.45
    assert np.median(ranges[twine]) == pytest.approx(1.3, abs=0.3)
    for row in (40, 100):  # meshes follow each other along every row
        assert np.abs(np.diff(twine[row].astype(int))).sum() > 20


def test_a_small_picture_shows_a_net_as_a_sharper_one_does(tmp_path: Path) -> None:
    """Twine thinner than a pixel is a part of it, not all of it here and nothing there."""
    quiet = {"scene": "net", "snow_per_m3": 0.0, "noise_sigma": 0.0}
    sharper = {**quiet, "width": 480, "height": 360, "supersampling": 3}
    small, sharp = written(tmp_path / "small", **quiet), written(tmp_path / "sharp", **sharper)
    mean = sharp.clean(1).reshape(90, 4, 120, 4, 3).mean(axis=(1, 3))
    assert np.corrcoef(small.clean(1).ravel(), mean.ravel())[0, 1] > 0.7


@pytest.mark.parametrize("scene", ["hull", "net"])
def test_a_vehicle_before_a_hull_or_a_net_faces_it(scene: str) -> None:
    with pytest.raises(ValidationError, match=f"a vehicle at a {scene} faces it"):
        SyntheticConfig.model_validate({"scene": scene, "turns": True})
