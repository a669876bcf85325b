"""Registration, false discoveries, shifts and frames: the parts of a comparison."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.survey.change.frames import in_site, on_earth, read_transform
from aquaflow.survey.change.registration import register
from aquaflow.survey.change.relief import best_shift, fill, hull_of
from aquaflow.survey.change.significance import discoveries, measured_spread, null_spread, two_sided
from aquaflow.telemetry.world_frame import WorldFrame


def relief(seed: int, noise: float) -> np.ndarray:
    random = np.random.default_rng(seed)
    xy = random.uniform(-1.0, 1.0, (8000, 2))
    z = 0.15 * np.sin(4.0 * xy[:, 0]) * np.cos(5.0 * xy[:, 1])
    return np.column_stack([xy, z + noise * random.standard_normal(len(xy))])


def normals_of(points: np.ndarray) -> np.ndarray:
    x, y = points[:, :2].T
    slope = np.column_stack([
        -0.6 * np.cos(4.0 * x) * np.cos(5.0 * y), 0.75 * np.sin(4.0 * x) * np.sin(5.0 * y),
        np.ones(len(x)),
    ])  # fmt: skip
    return np.asarray(slope / np.linalg.norm(slope, axis=1, keepdims=True))


def test_a_registration_finds_the_similarity_and_states_its_error() -> None:
    fixed, moving = relief(1, 0.003), relief(2, 0.003)
    T = Sim3(so3_exp(np.array([0.01, -0.02, 0.015])), np.array([0.02, -0.03, 0.02]), 1.01)
    found = register(fixed, normals_of(fixed), T.inverse().apply(moving), 0.02, 0.2)
    error = np.linalg.norm((found.T @ T.inverse()).apply(moving) - moving, axis=1)
    assert error.max() < 0.005
    assert found.shared > 0.9
    sigma = found.sigma_along(fixed, normals_of(fixed))
    assert 1e-5 < np.median(sigma) < 0.003


def test_changes_have_no_say_in_a_registration() -> None:
    fixed, moving = relief(1, 0.003), relief(2, 0.003)
    moving[moving[:, 0] > 0.6, 2] += 0.05
    found = register(fixed, normals_of(fixed), moving, 0.02, 0.2)
    still = moving[moving[:, 0] <= 0.6]
    assert np.linalg.norm(found.T.apply(still) - still, axis=1).max() < 0.006


def test_dives_that_share_no_ground_are_refused() -> None:
    fixed = relief(1, 0.003)
    with pytest.raises(InputError, match="give the --transform"):
        register(fixed, normals_of(fixed), fixed + np.array([0.0, 0.0, 5.0]), 0.02, 0.2)


def test_false_discoveries_stay_below_the_rate() -> None:
    random = np.random.default_rng(0)
    false, anything = [], 0
    for _ in range(200):
        scores = random.standard_normal(1000)
        anything += bool(discoveries(two_sided(scores, np.full(1000, np.inf)), 0.05).any())
        scores[:100] += 5.0
        found = discoveries(two_sided(scores, np.full(1000, np.inf)), 0.05)
        assert found[:100].mean() > 0.9
        false.append(found[100:].sum() / max(1, found.sum()))
    assert np.mean(false) < 0.06
    assert anything <= 20  # of 200, at 5 %


def test_places_that_were_not_seen_are_not_tested() -> None:
    chances = np.array([np.nan, 1e-9, 0.9, np.nan])
    np.testing.assert_array_equal(discoveries(chances, 0.05), [False, True, False, False])
    assert not discoveries(np.full(3, np.nan), 0.05).any()


def test_the_unchanged_say_how_wide_sigmas_have_to_be() -> None:
    random = np.random.default_rng(1)
    wide = np.append(3.0 * random.standard_normal(5000), np.full(500, 40.0))
    assert abs(null_spread(wide)[1] - 3.0) < 0.5
    assert null_spread(0.1 * random.standard_normal(5000))[1] == 1.0
    assert abs(measured_spread(0.1 * random.standard_normal(5000)) - 0.1) < 0.01
    assert null_spread(np.full(3, np.nan)) == (0.0, 1.0)


def test_a_shift_of_part_of_a_cell_is_found() -> None:
    y, x = np.mgrid[0:40, 0:40].astype(float)

    def scene(row: float, column: float) -> np.ndarray:
        bump = np.exp(-((y - row) ** 2 + 0.5 * (x - column) ** 2) / 18.0)
        return np.stack([bump, bump + 0.3 * np.sin(0.9 * (x - column))])

    thing = np.hypot(y - 18.0, x - 18.0) < 6.0
    move = best_shift(scene(18.0, 18.0), scene(21.4, 16.7), thing, 8)
    np.testing.assert_allclose(move.cells, (3.4, -1.3), atol=0.15)
    assert move.likeness > 0.95
    assert 0.0 < move.sigma_cells < 1.5


def test_holes_of_heights_are_filled_and_hulls_hold_their_cells() -> None:
    heights = np.add.outer(np.arange(5.0), np.arange(5.0))
    holes = heights.copy()
    holes[2, 2] = np.nan
    np.testing.assert_allclose(fill(holes), heights)
    mask = np.zeros((7, 7), bool)
    mask[1, 1] = mask[5, 1] = mask[1, 5] = True
    hull = hull_of(mask)
    assert hull[2, 2]
    assert not hull[5, 5]
    line = np.zeros((3, 3), bool)
    line[1] = True
    np.testing.assert_array_equal(hull_of(line), line)


def test_dives_without_a_place_on_earth_lie_in_one_frame() -> None:
    assert on_earth(WorldFrame.unknown(), WorldFrame.unknown()).scale == 1.0


@pytest.mark.parametrize(
    "text",
    [
        "no json",
        '{"rotation": [[1, 0], [0, 1]], "translation": [0, 0, 0]}',
        '{"rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]], "translation": [0, 0, 0]}',
        '{"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "translation": [0, 0, 0], "scale": -1}',
        "[]",
    ],
)
def test_a_transform_that_is_none_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "T.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"cannot read the transform .* give JSON"):
        read_transform(path)


def test_a_transform_is_read_as_it_stands(tmp_path: Path) -> None:
    path = tmp_path / "T.json"
    path.write_text(json.dumps({
        "scale": 2.0, "rotation": np.eye(3).tolist(), "translation": [1.0, 2.0, 3.0],
    }))  # fmt: skip
    np.testing.assert_allclose(read_transform(path).apply(np.ones((1, 3))), [[3.0, 4.0, 5.0]])


def test_a_site_without_the_dive_is_refused_with_those_that_it_has(tmp_path: Path) -> None:
    (tmp_path / "site.json").write_text('{"format": 1, "dives": []}')
    with pytest.raises(InputError, match="has no dive 'a'; it has none"):
        in_site(tmp_path, "a", "b")
