"""What telemetry makes known of a sub-map, what it does not, and the sentence that says why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.config import FusionConfig
from aquaflow.geometry.earth import latitude_longitude
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.dead_reckoning import carried_from
from aquaflow.telemetry.estimator import Estimate, estimate
from aquaflow.telemetry.factors import MOST
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.telemetry.world_frame import SourceReport
from aquaflow.types import (
    Acceleration,
    Altitude,
    Attitude,
    Depth,
    Position,
    TelemetrySample,
    Velocity,
)
from tests.telemetry import simulated_dives
from tests.telemetry.simulated_dives import (
    NOTHING,
    Swum,
    between,
    estimated,
    ground_of,
    part_of,
    stated_mounting,
    swum,
)

Array = npt.NDArray[np.float64]

ALL = ("depth", "attitude", "acceleration", "velocity", "altitude", "position")


def config(**changes: object) -> SyntheticConfig:
    telemetry = {"position_hz": 1.0, "position_sigma_m": 0.1, "position_outlier_share": 0.0}
    values = {
        "seed": 5, "frames": 400, "fps": 10, "width": 64, "height": 48, "altitude_m": 2.5,
        "altitude_swing_m": 0.8, "speed_m_s": 0.5, "telemetry": telemetry,
    }  # fmt: skip
    return SyntheticConfig.model_validate({**values, **changes})


@pytest.fixture(scope="module")
def dive() -> Swum:
    return swum(config(), *ALL)


@pytest.fixture(scope="module")
def turning() -> Swum:
    return swum(config(turns=True, roll_deg=8.0, pitch_deg=8.0, scene="flat_sand"), *ALL)


def report(found: Estimate, kind: str) -> SourceReport:
    (one,) = (each for each in found.frame.sources if each.kind == kind)
    return one


def without_mounting(swum: Swum) -> Estimate:
    return estimate(swum.telemetry, swum.path, FusionConfig(), None, lambda: NOTHING)


def scale_error(found: Estimate, swum: Swum) -> float:
    return float(np.log(found.frame.T_nm.scale / swum.T_nm.scale))


def tilt_deg(found: Estimate, swum: Swum) -> float:
    off = np.cross(found.frame.T_nm.R[2], swum.T_nm.R[2])
    return float(np.degrees(np.linalg.norm(off)))


def turn_deg(found: Estimate, swum: Swum) -> float:
    """About the vertical, from the truth, in which x is north."""
    turn = Rotation.from_matrix(found.frame.T_nm.R @ swum.T_nm.R.T).as_rotvec()
    return float(np.degrees(turn[2]))


def telemetry(samples: Sequence[TelemetrySample]) -> Telemetry:
    made = Telemetry()
    for sample in samples:
        made.add(sample)
    return made


# --- what becomes known ---------------------------------------------------------------------------


def test_depth_and_attitude_give_metres_gravity_and_magnetic_north(dive: Swum) -> None:
    found = estimated(part_of(dive, "depth", "attitude"))
    frame = found.frame
    assert (frame.metric, frame.level, frame.depth_known) == (True, True, True)
    assert frame.north == "magnetic north"
    assert abs(scale_error(found, dive)) < 4.0 * frame.scale_sigma < 0.02
    assert tilt_deg(found, dive) < 0.5
    assert frame.scale_source.startswith("pressure depth '")
    surface = dive.dive.T_wc[:, 2, 3].mean() - frame.T_nm.apply(dive.path.p_m)[:, 2].mean()
    assert abs(surface) < 1.5  # tide and the cell's own zero
    assert report(found, "depth").used > 100


def test_a_level_survey_has_no_scale_from_depth_and_says_so(dive: Swum) -> None:
    level = dive.path.p_m @ dive.T_nm.R.T
    level[:, 2] = 0.0
    path = CameraPath(dive.path.t_s, dive.path.R_mc, level @ dive.T_nm.R)
    samples = [Depth(int(t * 1e9), 0, "bar30", 5.0 + 0.002 * (k % 2))
               for k, t in enumerate(path.t_s)]  # fmt: skip
    made = telemetry([*samples, *(s for s in dive.dive.samples if isinstance(s, Attitude))])
    frame = estimated(Swum(dive.dive, path, dive.T_nm, made)).frame
    assert (frame.metric, frame.level, frame.unit) == (False, True, "map units")
    assert frame.scale_source.startswith("none: pressure depth give the scale to ")
    assert "because the camera rose and sank by only 0" in frame.scale_source
    assert frame.T_nm.scale == 1.0
    assert not frame.depth_known


@pytest.fixture(scope="module")
def drifted() -> Swum:
    """Ten minutes at one height, whose map has bent by more than the vehicle rose."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulated_dives, "TURN_RAD", np.radians(0.2))
        return swum(
            config(seed=1, frames=1500, fps=2.5, altitude_swing_m=0.02, scene="flat_sand"),
            "depth", "attitude", "velocity",
        )  # fmt: skip


def test_a_map_that_drifts_by_more_than_the_vehicle_rises_takes_no_scale_from_depth(
    drifted: Swum,
) -> None:
    frame = estimated(part_of(drifted, "depth", "attitude")).frame
    assert not frame.metric
    percent = int(frame.scale_source.split(" to ")[1].split(" %")[0])
    assert percent > 50


def test_a_dvl_is_not_refused_for_the_depth_of_a_map_that_drifted(drifted: Swum) -> None:
    found = estimated(drifted)
    assert found.frame.metric
    assert {each.kind for each in found.frame.sources if each.used == 0} == set()
    assert abs(scale_error(found, drifted)) < 0.01


def test_attitude_alone_is_level_in_the_maps_own_unit(dive: Swum) -> None:
    found = estimated(part_of(dive, "attitude"))
    assert (found.frame.metric, found.frame.level) == (False, True)
    assert found.frame.scale_source.startswith("none: no telemetry measures a length")


def test_a_dvl_without_attitude_gives_metres_but_no_gravity(dive: Swum) -> None:
    found = estimated(part_of(dive, "velocity"))
    frame = found.frame
    assert (frame.metric, frame.level, frame.north) == (True, False, "first keyframe")
    np.testing.assert_array_equal(frame.T_nm.R, np.eye(3))
    # No rotation shows its clock: its sigma is what parts of the path agree to, not 0.4 %.
    assert abs(scale_error(found, dive)) < 4.0 * frame.scale_sigma < 0.03
    assert frame.scale_source.startswith("DVL '")


def test_an_altimeter_gives_metres_where_its_beam_meets_the_map(dive: Swum) -> None:
    part = part_of(dive, "attitude", "altitude")
    found = estimated(part, ground_of(part))
    assert found.frame.metric
    assert abs(scale_error(found, dive)) < 4.0 * found.frame.scale_sigma < 0.03
    nothing = estimated(part)
    assert not nothing.frame.metric
    assert report(nothing, "altitude").reason == "its beam meets nothing of the map"


def test_depth_alone_levels_a_path_that_leaves_its_plane(dive: Swum) -> None:
    found = estimated(part_of(dive, "depth"))
    assert found.frame.level
    assert tilt_deg(found, dive) < np.degrees(4.0 * found.frame.tilt_sigma_rad)


def test_gravity_comes_from_specific_force_where_there_is_no_attitude(dive: Swum) -> None:
    found = estimated(part_of(dive, "acceleration", "depth"))
    assert found.frame.level
    assert tilt_deg(found, dive) < np.degrees(4.0 * found.frame.tilt_sigma_rad)
    assert found.frame.north == "initial heading"
    assert report(found, "acceleration").used > 100


def test_a_heading_that_is_not_trusted_makes_the_first_one_x(dive: Swum) -> None:
    found = estimated(part_of(dive, "depth", "attitude"), heading=False)
    frame = found.frame
    assert frame.north == "initial heading"
    assert frame.T_bc is not None
    R_nb = frame.T_nm.R @ dive.path.R_mc[0] @ frame.T_bc.R.T
    assert np.degrees(np.arctan2(R_nb[1, 0], R_nb[0, 0])) == pytest.approx(0.0, abs=1.0)
    assert frame.heading_sigma_rad < np.radians(1.0)


def test_positions_give_true_north_and_an_origin(dive: Swum) -> None:
    found = estimated(part_of(dive, "depth", "attitude", "velocity", "position"))
    frame = found.frame
    assert frame.georeferenced
    assert frame.north == "true north"
    assert frame.origin is not None
    assert abs(np.radians(turn_deg(found, dive))) < 4.0 * frame.heading_sigma_rad
    assert found.solution is not None


# --- the camera's mounting ------------------------------------------------------------------------


def test_an_unknown_mounting_is_found_from_turns(turning: Swum) -> None:
    found = without_mounting(part_of(turning, "depth", "attitude"))
    assert (found.frame.metric, found.frame.level) == (True, True)
    assert found.frame.T_bc is not None
    off = Rotation.from_matrix(found.frame.T_bc.R @ turning.dive.T_bc[:3, :3].T).magnitude()
    assert np.degrees(off) < 3.0
    assert tilt_deg(found, turning) < 1.5


def test_an_unknown_mounting_that_no_turn_shows_is_refused_with_its_reason(dive: Swum) -> None:
    R = np.tile(dive.path.R_mc[0], (len(dive.path), 1, 1))
    straight = replace(dive, path=CameraPath(dive.path.t_s, R, dive.path.p_m))
    found = without_mounting(part_of(straight, "attitude", "acceleration", "velocity", "altitude"))
    assert (found.frame.metric, found.frame.level) == (False, False)
    said = "how the camera is mounted in the vehicle is unknown: set fusion.camera"
    assert report(found, "attitude").reason == said
    assert report(found, "acceleration").reason == said


# --- sources that say nothing, and why ------------------------------------------------------------


def test_a_short_sub_map_gets_no_frame_of_its_own(dive: Swum) -> None:
    four = between(dive.path, 0.0, 0.3, 1.0)
    frame = estimated(replace(dive, path=four)).frame
    assert frame.is_identity
    assert "the sub-map has only 4 poses" in frame.scale_source


def test_no_telemetry_leaves_the_map_as_it_is(dive: Swum) -> None:
    assert estimated(replace(dive, telemetry=Telemetry())).frame.is_identity


def test_telemetry_of_another_time_is_named_with_both_times(dive: Swum) -> None:
    late = [replace(s, t_ns=s.t_ns + 10**12) for s in dive.dive.samples if isinstance(s, Depth)]
    found = estimated(replace(dive, telemetry=telemetry(late)))
    assert "no telemetry could be used" in found.frame.scale_source
    reason = report(found, "depth").reason
    assert reason.startswith("its samples are of 1000 to 10")
    assert reason.endswith("s, the camera's poses of 0 to 40 s")


def test_a_handful_of_samples_is_left_out(dive: Swum) -> None:
    few = [s for s in dive.dive.samples if isinstance(s, Depth)][:4]
    found = estimated(replace(dive, telemetry=telemetry(few)))
    assert report(found, "depth").reason == "only 4 samples"


def test_samples_in_a_gap_of_the_path_are_left_out(dive: Swum) -> None:
    kept = (dive.path.t_s < 5.0) | (dive.path.t_s > 35.0)
    path = CameraPath(dive.path.t_s[kept], dive.path.R_mc[kept], dive.path.p_m[kept])
    inside = [s for s in dive.dive.samples if isinstance(s, Depth) and 6e9 < s.t_ns < 34e9]
    found = estimated(replace(dive, path=path, telemetry=telemetry(inside)))
    assert report(found, "depth").reason == "too few samples while the camera had a pose"


def test_depth_of_a_level_map_without_gravity_says_what_is_missing(dive: Swum) -> None:
    flat = dive.path.p_m.copy()
    flat[:, 1] = 0.0
    path = CameraPath(dive.path.t_s, dive.path.R_mc, flat)
    found = estimated(part_of(replace(dive, path=path), "depth"))
    assert report(found, "depth").reason == "nothing measures where down is"


def test_a_dvl_that_sends_once_a_second_has_no_second_without_a_gap(dive: Swum) -> None:
    slow = [Velocity(k * 10**9, 0, "dvl", (0.5, 0.0, 0.0), 0.01) for k in range(1, 39)]
    found = estimated(replace(dive, telemetry=telemetry(slow)))
    assert report(found, "velocity").reason == "no second without a gap in it"


def test_a_force_that_is_no_gravity_is_refused(dive: Swum) -> None:
    blows = [Acceleration(k * 10**8, 0, "imu", (0.0, 0.0, -30.0)) for k in range(1, 300)]
    found = estimated(replace(dive, telemetry=telemetry(blows)))
    assert report(found, "acceleration").reason == "it does not look like gravity"


def test_samples_that_contradict_their_neighbours_are_counted(dive: Swum) -> None:
    samples = list(part_of(dive, "depth", "attitude").dive.samples)
    wrong = [
        replace(s, depth_m=s.depth_m + 3.0) if isinstance(s, Depth) and k % 40 == 0 else s
        for k, s in enumerate(samples)
    ]
    chosen = [s for s in wrong if isinstance(s, (Depth, Attitude))]
    found = estimated(replace(dive, telemetry=telemetry(chosen)))
    depth = report(found, "depth")
    assert depth.rejected > 0
    assert depth.reason == "contradicts the samples around it"
    assert abs(scale_error(found, dive)) < 4.0 * found.frame.scale_sigma


# --- from one sub-map to the next -----------------------------------------------------------------


def test_what_one_sub_map_has_shown_is_carried_to_the_next(dive: Swum) -> None:
    part = part_of(dive, "depth", "attitude", "velocity")
    first, second = between(dive.path, 0.0, 20.0, 1.0), between(dive.path, 25.0, 39.0, 0.7)
    mounting = stated_mounting(dive.dive)
    settings = FusionConfig(heading=False)
    before = estimate(part.telemetry, first, settings, mounting, lambda: NOTHING)
    carried = carried_from(before, first, part.telemetry, second)
    assert carried is not None
    after = estimate(part.telemetry, second, settings, mounting, lambda: NOTHING, carried=carried)
    assert after.frame.metric
    report(after, "dead_reckoning")
    # The turn from the one to the other is the true one, although x of n is no north.
    true = first_to_second(dive)
    R_n = after.frame.T_nm.R @ second.R_mc[0]
    found = (before.frame.T_nm.R @ first.R_mc[0]).T @ R_n
    assert np.degrees(Rotation.from_matrix(found.T @ true).magnitude()) < 15.0
    alone = estimate(part.telemetry, second, settings, mounting, lambda: NOTHING)
    assert not any(each.kind == "dead_reckoning" for each in alone.frame.sources)


def first_to_second(dive: Swum) -> Array:
    """[3, 3] true turn of the camera from 0 s to 25 s."""
    R = dive.dive.T_wc[:, :3, :3]
    return np.asarray(R[0].T @ R[250])


# --- positions without gravity --------------------------------------------------------------------


def fixes_of(dive: Swum, every: int) -> list[TelemetrySample]:
    """Exact fixes of the camera, at the moments of poses."""
    p_n = dive.dive.T_wc[::every, :3, 3]
    latitude, longitude = latitude_longitude(p_n, (63.4, 10.4))
    return [
        Position(round(t * 1e9), 0, "usbl", a, b, 0.1)
        for t, a, b in zip(dive.path.t_s[::every], latitude, longitude, strict=True)
    ]


def of_fixes(dive: Swum, extra: Sequence[TelemetrySample] = (), **settings: object) -> Estimate:
    made = telemetry([*fixes_of(dive, 20), *extra])
    values = FusionConfig.model_validate({"position_lag_sigma_s": 0.0, **settings})
    return estimate(made, dive.path, values, None, lambda: NOTHING)


def test_positions_alone_level_the_map_at_an_assumed_constant_depth() -> None:
    lawn = swum(config(seed=3, frames=600, altitude_swing_m=0.1), "position")
    found = of_fixes(lawn)
    assert found.frame.metric
    assert abs(scale_error(found, lawn)) < 4.0 * found.frame.scale_sigma
    assert found.frame.level
    assert found.frame.georeferenced
    assert tilt_deg(found, lawn) < np.degrees(4.0 * found.frame.tilt_sigma_rad)
    assert not found.frame.depth_known
    assert report(found, "constant_depth").source == "assumed"
    loose = of_fixes(lawn, depth_change_sigma_m=10.0)
    assert not loose.frame.level


def test_every_fix_has_its_error_and_the_wrong_ones_are_marked(dive: Swum) -> None:
    """Also those beyond the number that the estimate takes."""
    fixes = fixes_of(dive, 1)
    assert len(fixes) > MOST
    wrong = [60, 150]
    for k in wrong:
        assert isinstance(fixes[k], Position)
        fixes[k] = replace(fixes[k], latitude_deg=fixes[k].latitude_deg + 5.0 / 111_000.0)
    made = telemetry([*fixes, *(s for s in dive.dive.samples if isinstance(s, Depth))])
    settings = FusionConfig(position_lag_sigma_s=0.0)
    found = estimate(made, dive.path, settings, None, lambda: NOTHING)
    (errors,) = found.frame.fixes
    assert len(errors.t_s) == len(fixes)
    assert np.median(errors.errors_m) < 0.1
    np.testing.assert_allclose(errors.errors_n[wrong, 0], -5.0, atol=0.5)
    step = -(-len(fixes) // MOST)
    assert set(np.flatnonzero(errors.rejected)) == {k for k in wrong if k % step == 0}


def test_positions_and_depth_level_the_map_without_any_assumption(dive: Swum) -> None:
    found = of_fixes(dive, [s for s in dive.dive.samples if isinstance(s, Depth)])
    assert (found.frame.metric, found.frame.level, found.frame.depth_known) == (True, True, True)
    assert tilt_deg(found, dive) < np.degrees(4.0 * found.frame.tilt_sigma_rad)
    assert not any(each.kind == "constant_depth" for each in found.frame.sources)


def test_fixes_at_poses_count_however_far_apart_the_poses_are(dive: Swum) -> None:
    sparse = CameraPath(dive.path.t_s[::50], dive.path.R_mc[::50], dive.path.p_m[::50])
    found = estimate(
        telemetry(fixes_of(dive, 50)), sparse, FusionConfig(position_lag_sigma_s=0), None,
        lambda: NOTHING,
    )  # fmt: skip
    assert report(found, "position").used == len(sparse)


def test_two_fixes_are_too_few(dive: Swum) -> None:
    found = estimate(telemetry(fixes_of(dive, 200)), dive.path, FusionConfig(), None,
                     lambda: NOTHING)  # fmt: skip
    assert report(found, "position").reason == "only 2 samples"


def test_altitudes_without_a_scale_before_are_taken_from_the_right_place(dive: Swum) -> None:
    samples = [s for s in dive.dive.samples if isinstance(s, (Altitude, Attitude))]
    ground = ground_of(dive)[::3]
    errors = []
    for unit in (0.2, 5.0):
        path = CameraPath(dive.path.t_s, dive.path.R_mc, unit * dive.path.p_m)
        found = estimated(replace(dive, path=path, telemetry=telemetry(samples)), unit * ground)
        errors.append(scale_error(found, dive) + np.log(unit))
    assert np.abs(errors).max() < 0.02
    np.testing.assert_allclose(errors, errors[0], atol=2e-3)
