"""From one sub-map to the next across a blackout: a place with a true sigma, or none."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.config import FusionConfig
from aquaflow.geometry.alignment import align
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.dead_reckoning import carried_from
from aquaflow.telemetry.estimator import Estimate, estimate
from aquaflow.telemetry.solve import Carried
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.types import Velocity
from tests.telemetry.simulated_dives import (
    NOTHING,
    Swum,
    between,
    stated_mounting,
    swum,
    telemetry_of,
)

Array = npt.NDArray[np.float64]

LOST_S, FOUND_S, END_S = 25.0, 45.0, 65.0
KINDS = ("depth", "attitude", "velocity")


@functools.cache
def dive(seed: int) -> Swum:
    rng = np.random.default_rng(seed)
    return swum(
        SyntheticConfig.model_validate(
            {
                "seed": seed, "frames": 660, "fps": 10, "width": 64, "height": 48,
                "scene": "flat_sand",
                "altitude_m": 2.0, "altitude_swing_m": float(rng.uniform(0.4, 1.0)),
                "speed_m_s": float(rng.uniform(0.3, 0.7)),
                "mounting_error_deg": float(rng.uniform(0.0, 4.0)),
            }
        ),
        *KINDS,
    )  # fmt: skip


def parts(swum: Swum) -> tuple[CameraPath, CameraPath]:
    """Two sub-maps, each with a unit of its own."""
    return between(swum.path, 0.0, LOST_S, 1.0), between(swum.path, FOUND_S, END_S, 0.6)


def one(swum: Swum, path: CameraPath, heading: bool, carried: Carried | None = None) -> Estimate:
    settings = FusionConfig(heading=heading)
    mounting = stated_mounting(swum.dive)
    return estimate(swum.telemetry, path, settings, mounting, lambda: NOTHING, carried=carried)


@functools.cache
def before_it(seed: int, heading: bool) -> Estimate:
    """Of a dive's first sub-map."""
    return one(dive(seed), parts(dive(seed))[0], heading)


def carried(telemetry: Telemetry | None = None) -> Carried | None:
    """Across the blackout of dive 0."""
    first, second = parts(dive(0))
    before = before_it(0, heading=True)
    return carried_from(before, first, telemetry or dive(0).telemetry, second)


@pytest.mark.parametrize("heading", [True, False])
@pytest.mark.parametrize(
    "seeds",
    [range(1), pytest.param(range(1, 11), marks=pytest.mark.slow)],
    ids=["one dive", "ten dives"],
)
def test_after_20_s_of_blackout_the_next_sub_map_lies_within_its_stated_3_sigma(
    seeds: range, heading: bool
) -> None:
    squares = []
    for seed in seeds:
        made = dive(seed)
        first, second = parts(made)
        before = before_it(seed, heading)
        after = one(made, second, heading, carried_from(before, first, made.telemetry, second))
        assert after.frame.metric
        assert any(each.kind == "dead_reckoning" for each in after.frame.sources)
        # The first sub-map's own frame against the truth is common to both, except for its turn
        # about the vertical: x of n is no exact north.
        truth = made.dive.T_wc[:, :3, 3]
        seen = made.dive.times_s <= LOST_S
        T = level_alignment(before.frame.T_nm.apply(first.p_m), truth[seen])
        begins = after.frame.T_nm.apply(second.p_m[:1])
        true = truth[np.searchsorted(made.dive.times_s, FOUND_S - 1e-6)]
        off = (begins @ T[0].T + T[1] - true)[0, :2]
        covariance = after.frame.position_covariance(begins[0])[:2, :2]
        squares.append(float(off @ np.linalg.solve(covariance, off)))
        assert np.sqrt(np.trace(covariance)) < 1.5
    assert np.sqrt(max(squares)) < 3.0


def level_alignment(
    points: Array,  # [N, 3]
    truth: Array,  # [N, 3]
) -> tuple[Array, Array]:
    """R [3, 3] about the vertical and t [3] that take points to the truth."""
    flat, flat_truth = points.copy(), truth.copy()
    flat[:, 2] = flat_truth[:, 2] = 0.0
    T = align(flat, flat_truth, with_scale=False).T_target_source
    return T.R, T.t


def test_without_a_dvl_no_place_is_carried_but_the_mounting_is() -> None:
    made = dive(0)
    found = carried(telemetry_of(made.dive, "depth", "attitude"))
    assert found is not None
    assert found.place is None
    after = one(made, parts(made)[1], heading=True, carried=found)
    assert not any(each.kind == "dead_reckoning" for each in after.frame.sources)
    before = before_it(0, heading=True)
    assert before.solution is not None
    np.testing.assert_array_equal(found.state.R_bc, before.solution.state.R_bc)


def test_without_attitude_no_place_is_carried() -> None:
    found = carried(telemetry_of(dive(0).dive, "depth", "velocity"))
    assert found is not None
    assert found.place is None


def test_a_dvl_that_was_silent_for_long_gives_no_place() -> None:
    found = carried(without_bottom_lock(dive(0), 3.0, 17.0))
    assert found is not None
    assert found.place is None


def test_a_silence_that_is_bridged_widens_the_sigma() -> None:
    made = dive(0)
    whole, bridged = carried(), carried(without_bottom_lock(made, 5.0, 12.0))
    assert whole is not None
    assert bridged is not None
    assert whole.place is not None
    assert bridged.place is not None
    assert np.trace(bridged.place[2]) > np.trace(whole.place[2])


def without_bottom_lock(made: Swum, first_s: float, last_s: float) -> Telemetry:
    """Lost between two moments of the blackout; all else goes on."""
    telemetry = telemetry_of(made.dive, "depth", "attitude")
    for sample in made.dive.samples:
        lost = LOST_S + first_s < sample.t_ns * 1e-9 < LOST_S + last_s
        if isinstance(sample, Velocity) and not lost:
            telemetry.add(sample)
    return telemetry


def test_nothing_is_carried_from_a_sub_map_without_metres() -> None:
    made = dive(0)
    first, second = parts(made)
    before = before_it(0, heading=True)
    for frame in (WorldFrame.unknown(), replace(before.frame, level=False)):
        assert carried_from(replace(before, frame=frame), first, made.telemetry, second) is None
    nothing = CameraPath(np.zeros(0), np.zeros((0, 3, 3)), np.zeros((0, 3)))
    assert carried_from(before, first, made.telemetry, nothing) is None
    unsolved = replace(before, solution=None)
    assert carried_from(unsolved, first, made.telemetry, second) is None
