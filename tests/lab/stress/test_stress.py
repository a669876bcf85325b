"""The short form of ``aquaflow lab stress`` passes, and each guard is what makes its case pass."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pydoc import locate

import numpy as np
import pytest
import torch

from aquaflow.base.errors.crash_report import MISUSED
from aquaflow.config import TrackingConfig
from aquaflow.geometry import camera, similarity, two_view
from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.stress import suite, swim
from aquaflow.lab.stress.case import REGISTRY, Check
from aquaflow.mapping import gaussians, optimisation
from aquaflow.optimise.least_squares import NormalEquations
from aquaflow.prior import flow, homography
from aquaflow.render import adam, photometric, reference, views, water
from aquaflow.sources import preprocessing
from aquaflow.tracking import current_keyframe
from aquaflow.tracking.initialisation import bundle, initialiser
from aquaflow.water import medium
from tests.command_line import Cli, refused

INFINITY = float("inf")


@pytest.fixture(autouse=True)
def _few_threads() -> Iterator[None]:
    with suite.on_few_threads():
        yield


ALL = suite.cases(long=True)
SECONDS = {"half_a_minute_at_one_place", "tracked_frames", "snow"}
"""Cases of the short form that take longer than all others together."""
SHORT = [
    pytest.param(case, id=case.name, marks=[pytest.mark.slow] if case.name in SECONDS else [])
    for case in ALL
    if not case.long
]


@pytest.mark.parametrize("case", SHORT)
def test_a_case_of_the_short_form_passes(case: suite.Case) -> None:
    result = suite.run_case(case, seed=0)
    assert result.outcome.passed, f"{result.outcome.detail}; reproduce with: {result.command}"


@pytest.mark.slow
@pytest.mark.parametrize("case", [c for c in ALL if c.long], ids=lambda case: case.name)
def test_a_case_of_the_long_form_passes(case: suite.Case) -> None:
    result = suite.run_case(case, seed=0)
    assert result.outcome.passed, f"{result.outcome.detail}; reproduce with: {result.command}"


def test_every_family_has_cases_and_every_case_names_a_guard_that_exists() -> None:
    assert {case.family for case in ALL} == set(suite.FAMILIES)
    for case in ALL:
        assert locate(f"aquaflow.{case.guard}") is not None, case.name


# --- what each guard is for -----------------------------------------------------------------------


def unguarded_step(equations: NormalEquations, damping: float) -> np.ndarray:
    return -np.linalg.solve(equations.H, equations.gradient)


def always(*_: object) -> bool:
    return True


def all_rows(grads: dict[str, torch.Tensor], rows: int) -> torch.Tensor:
    return torch.ones(rows, dtype=torch.bool)


def everything(pixels: np.ndarray) -> np.ndarray:
    return np.ones(pixels.shape[:-1], dtype=bool)


def no_library() -> None:
    return None


GUARDS: list[tuple[str, list[tuple[object, str, object]]]] = [
    ("zero_and_denormal_quaternions", [(reference, "MIN_QUAT_NORM_SQ", -1.0)]),
    ("behind_the_camera", [(reference, "NEAR_PLANE_M", -INFINITY)]),
    ("on_the_camera_centre", [(reference, "NEAR_PLANE_M", -INFINITY)]),
    ("huge_scales", [(reference, "MAX_SIGMA_PX", INFINITY)]),
    ("tiny_scales", [(reference, "DILATION_PX2", 0.0)]),
    ("attenuation_0_to_50", [(medium, "MAX_OPTICAL_DEPTH", INFINITY)]),
    ("transmission_to_0", [(medium, "MIN_TRANSMISSION", 0.0)]),
    ("B_inf_at_0_and_1", [(medium, "B_INF_RANGE", (0.0, 1.0))]),
    ("rates_at_0_and_50", [(medium, "MIN_RATE", 0.0)]),
    ("black_and_glowing_radiance", [(gaussians, "MIN_RADIANCE", 0.0)]),
    ("picture_through_bare_map", [(water, "MIN_SOLID", 0.0)]),
    ("depth_loss_at_range_0", [(photometric, "MIN_RANGE", 0.0)]),
    ("rank_deficient", [(NormalEquations, "solve", unguarded_step)]),
    ("nan_matches_in_bundle", [(bundle, "is_measured", everything)]),
    ("points_behind_the_camera", [(two_view, "MIN_DEPTH", -INFINITY)]),
    ("parallel_rays", [(two_view, "MIN_PARALLAX_RAD", -1.0)]),
    ("projection_at_depth_0", [(camera, "MIN_DEPTH", -INFINITY)]),
    ("homography_horizon", [(homography, "MIN_DENOMINATOR", 0.0)]),
    ("poses_rounded_to_float32", [(similarity, "on_so3", lambda R: R)]),
    ("nan_in_range_input", [(optimisation, "is_number", always)]),
    ("nan_in_pose_gradient", [(views, "is_usable", always)]),
    (
        "gradients_that_are_not_finite",
        [(adam, "sound_rows", all_rows), (adam, "library_or_none", no_library)],
    ),
    ("nan_in_float_picture", [(preprocessing, "check_picture", always)]),
    ("one_by_one", [(preprocessing, "check_picture", always)]),
    ("black", [(flow, "MIN_TEXTURE", -1.0)]),
    ("white", [(flow, "MIN_TEXTURE", -1.0)]),
    (
        "pure_rotation",
        [
            (initialiser.Initialiser, "_trustworthy", always),
            (initialiser.Initialiser, "_is_decided", always),
            (two_view, "MIN_PARALLAX_RAD", -1.0),
        ],
    ),
    pytest.param(
        "snow",
        [(current_keyframe.KeyframeTracker, "is_hidden", lambda *_: False)],
        marks=pytest.mark.slow,
    ),
]


@pytest.mark.parametrize(
    ("name", "removed"), GUARDS, ids=lambda part: part if isinstance(part, str) else "off"
)
def test_without_its_guard_the_case_fails(
    name: str, removed: list[tuple[object, str, object]], monkeypatch: pytest.MonkeyPatch
) -> None:
    for owner, guard, instead in removed:
        assert hasattr(owner, guard)
        monkeypatch.setattr(owner, guard, instead)
    assert not suite.run_case(REGISTRY[name], seed=0).outcome.passed


def test_a_pose_that_too_little_supports_is_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Chance matches after a jump; no picture supports a pose by more than all of its pixels."""
    frames = swim.film(swim.Floor(0), swim.path(8))
    posed = len(swim.track(frames).posed)
    monkeypatch.setattr(swim, "TrackingConfig", lambda: TrackingConfig(min_support=0.999))
    assert len(swim.track(frames).posed) < posed == len(frames)


def test_without_the_finite_check_an_unsound_gaussian_stops_the_map(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(optimisation.MapOptimiser, "drop_unsound", lambda self: None)
    assert not suite.run_case(REGISTRY["nan_in_the_map"], seed=0).outcome.passed


# --- the instrument itself ------------------------------------------------------------------------


def failing(break_it: Callable[[Check], None]) -> Check:
    check = Check()
    break_it(check)
    return check


@pytest.mark.parametrize(
    "break_it",
    [
        lambda check: check.true("it holds", False),
        lambda check: check.below("error", 2.0, 1.0),
        lambda check: check.below("error", float("nan"), 1.0),
        lambda check: check.finite("values", np.array([1.0, np.inf])),
        lambda check: check.finite("values", torch.tensor([float("nan")])),
        lambda check: check.pose("pose", Sim3(np.diag([1.0, 1.0, -1.0]), np.zeros(3))),
        lambda check: check.pose("pose", Sim3(np.eye(3), np.zeros(3), -1.0)),
        lambda check: check.pose("pose", Sim3(1.001 * np.eye(3), np.zeros(3))),
    ],
)
def test_a_broken_expectation_is_a_failure(break_it: Callable[[Check], None]) -> None:
    assert not failing(break_it).outcome().passed


def test_the_worst_value_is_the_one_nearest_to_its_bound() -> None:
    check = Check()
    check.below("far", 5.0, 100.0)
    check.below("near", 0.9, 1.0)
    outcome = check.outcome()
    assert (outcome.passed, outcome.worst) == (True, 0.9)
    assert "near" in outcome.detail


def test_an_exception_is_a_failure_with_its_seed() -> None:
    def breaks(seed: int) -> suite.StressOutcome:
        raise RuntimeError("out\nof range")

    result = suite.run_case(suite.Case("broken", "solvers", "a.b", breaks, long=False), seed=7)
    assert not result.outcome.passed
    assert "RuntimeError: out of range" in result.outcome.detail
    assert result.command == "aquaflow lab stress --case broken --seed 7"
    assert result.to_json()["worst"] is None


def test_the_command_prints_a_table_and_json(aquaflow: Cli) -> None:
    table = aquaflow("lab", "stress", "--family", "water")
    assert table.code == 0, table.err
    assert "transmission_to_0" in table.out
    ran = aquaflow("lab", "stress", "--case", "sim3_chain", "--seed", 3, "--json")
    (row,) = json.loads(ran.out)["cases"]
    assert {"name", "family", "passed", "worst", "guard", "seed"} <= set(row)
    assert (row["name"], row["passed"], row["seed"]) == ("sim3_chain", True, 3)


def test_an_unknown_family_or_case_is_refused(aquaflow: Cli) -> None:
    refused(aquaflow("lab", "stress", "--family", "weather"), "weather", code=MISUSED)
    refused(aquaflow("lab", "stress", "--case", "weather"), "weather", code=MISUSED)
