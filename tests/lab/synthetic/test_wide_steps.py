"""The scenes with a wide step from picture to picture, and the display burned into them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.dive import write_dive
from aquaflow.lab.synthetic.truth import Truth, read_truth

TINY = {"width": 96, "height": 72, "supersampling": 1}


def written(out: Path, **settings: object) -> Truth:
    write_dive(out, SyntheticConfig.model_validate({**TINY, **settings}))
    return read_truth(out)


def shared(truth: Truth, i: int, j: int) -> float:
    """Share of what picture i shows that falls into picture j."""
    T = truth.T_wc[j]
    local = (truth.points_w(i).reshape(-1, 3) - T[:3, 3]) @ T[:3, :3]
    pixels = truth.camera.project(local)
    inside = (pixels > 0) & (pixels < (truth.camera.width, truth.camera.height))
    return float((inside.all(axis=1) & (local[:, 2] > 0)).mean())


def turns_deg(truth: Truth) -> np.ndarray:
    """Between consecutive pictures."""
    R = Rotation.from_matrix(truth.T_wc[:, :3, :3])
    return np.degrees((R[:-1].inv() * R[1:]).magnitude())


def test_a_survey_looks_down_and_shares_two_thirds_with_the_next_picture(tmp_path: Path) -> None:
    truth = written(tmp_path, scene="survey")
    assert len(truth) == 9
    assert (truth.T_wc[:, 2, 2] > 0.99).all(), "z of the camera points down"
    shares = [shared(truth, k, k + 1) for k in range(8)]
    assert min(shares) > 0.55
    assert max(shares) < 0.8
    assert np.linalg.norm(truth.T_wc[8, :3, 3] - truth.T_wc[0, :3, 3]) > 3.5, "it does not return"


def test_a_pool_is_seen_forward_in_wide_steps_and_all_round(tmp_path: Path) -> None:
    truth = written(tmp_path, scene="pool", frames=60, width=32, height=24)
    steps = np.linalg.norm(np.diff(truth.T_wc[:, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(steps, 0.25, atol=0.03)
    assert 4.0 < np.median(turns_deg(truth)) < 8.0
    forward = truth.T_wc[:, :3, 2]
    assert (np.abs(forward[:, 2]) < 0.3).all(), "nearly level"
    ahead = np.einsum("ni,ni->n", forward[:-1], np.diff(truth.T_wc[:, :3, 3], axis=0)) / steps
    assert ahead.min() > 0.9, "the camera looks where the vehicle goes"
    assert all(np.isfinite(truth.range_m(k)).all() for k in range(0, 60, 10)), "walls all round"


def test_a_long_dive_in_a_pool_makes_several_laps_of_different_width() -> None:
    from aquaflow.lab.synthetic.ways import way_of

    config = SyntheticConfig.model_validate({"scene": "pool"})
    assert config.frames == 220
    way = way_of(config)
    steps = np.linalg.norm(np.diff(way.points, axis=0), axis=1)
    np.testing.assert_allclose(steps.sum(), config.speed_m_s * config.duration_s, rtol=1e-3)
    np.testing.assert_array_equal(way.points[0], way.points[-1])
    laps = (way.heading[-1] - way.heading[0]) / (2.0 * np.pi)
    assert abs(laps) == pytest.approx(4.0, abs=0.02)
    radius = np.linalg.norm(way.points / (1.0, 0.6), axis=1)
    assert radius.max() / radius.min() > 1.2


def test_a_pool_has_a_floor_and_four_walls_of_equal_tiles() -> None:
    from aquaflow.lab.synthetic import pool

    basin = pool.tiled_basin(np.zeros(2), np.array([6.0, 4.0]), np.random.default_rng(0))
    assert len(basin) == 5
    assert len({shape.tile_m for shape in basin}) == 1
    assert pool.TILES_M[0] <= basin[0].tile_m <= pool.TILES_M[1]


@pytest.mark.parametrize("display", ["clock", "clock_and_crosshair", "panel"])
def test_a_display_covers_little_of_the_picture_and_nothing_of_the_truth(
    display: str, tmp_path: Path
) -> None:
    plain = written(tmp_path / "plain", scene="survey", frames=2)
    shown = written(tmp_path / "shown", scene="survey", frames=2, display=display)
    for k in range(2):
        changed = (plain.image(k) != shown.image(k)).any(axis=-1)
        assert 0.01 < changed.mean() < 0.25
        centre = changed[36, 48]
        assert centre == (display == "clock_and_crosshair")
        np.testing.assert_array_equal(plain.range_m(k), shown.range_m(k))
        np.testing.assert_array_equal(plain.clean(k), shown.clean(k))
    assert shown.config.display == display


def test_the_burned_in_clock_goes_with_the_dive_s_time() -> None:
    from aquaflow.lab.synthetic.display import burn_in

    drawn = []
    for t_s in (0.0, 0.9, 1.0):
        picture = np.zeros((120, 160, 3), np.uint8)
        burn_in(picture, "clock", t_s)
        drawn.append(picture)
    assert (drawn[0] == drawn[1]).all()
    assert (drawn[0] != drawn[2]).any()


def test_what_is_asked_for_wins_over_the_scene_s_own_defaults() -> None:
    config = SyntheticConfig.model_validate({"scene": "pool", "frames": 12})
    assert (config.frames, config.fps) == (12, 1.0)
    assert SyntheticConfig.model_validate({"scene": "reef"}).fps == 10.0
