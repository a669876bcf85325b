"""Initialisation: waits for parallax, decides rightly on plane and relief, keeps memory bounded."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.config import InitialisationConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_log
from aquaflow.tracking.initialisation import initialiser as initialiser_module
from aquaflow.tracking.initialisation.initialiser import (
    Hypotheses,
    Initialiser,
    MatchedFrame,
    calibrate,
)
from tests.tracking.tracking_scenes import KnownPair, KnownPrior, KnownView, depth_map, pose

CAMERA = CameraModel(96, 72, 80.0, 80.0, 48.0, 36.0)
CONFIG = InitialisationConfig(points=300, pairs=1)
GUESS = replace(CAMERA.with_focal_scaled(1.2), calibrated=False)

MOVING = [pose((0.01 * i, 0.03 * i, -0.04 * i), (0.06 * i, 0.02 * i, 0.03 * i)) for i in range(7)]
CURVED = [
    pose(
        (0.03 * np.sin(i), 0.02 * i, -0.03 * i),
        (0.07 * i, 0.12 * np.sin(i), 0.05 * np.sin(2 * i)),
    )
    for i in range(7)
]
"""Over a plane, a straight way has two explanations that are equally good; a curved one has one."""
TURNING = [pose((0.02 * i, -0.03 * i, 0.05 * i), (0.0, 0.0, 0.0)) for i in range(6)]


def prior_of(
    poses: list[Sim3], flat: bool = False, noise_px: float = 0.1, blind: tuple[int, ...] = ()
) -> KnownPrior:
    """Views whose first is the reference; only its depth is ever used to match forward."""
    depth = depth_map(CAMERA, flat)
    views = [KnownView(CAMERA, T, depth, i in blind) for i, T in enumerate(poses)]
    return KnownPrior(views, CAMERA, noise_px)


def started(
    prior: KnownPrior,
    config: InitialisationConfig = CONFIG,
    camera: CameraModel = CAMERA,
) -> Initialiser:
    """An initialiser that was given every frame."""
    frames = prior.frames(camera)
    initialiser = Initialiser(frames[0], prior.encode(frames[0].image, camera), prior, config)
    for frame in frames[1:]:
        assert initialiser.add(frame, prior.encode(frame.image, camera))
        initialiser.thin()
    return initialiser


def assert_poses(initialiser: Initialiser, poses: list[Sim3], tolerance: float) -> None:
    """The relative poses are the true ones up to one common scale."""
    solution = initialiser.solve()
    assert solution is not None
    truth = [poses[w.frame.index].inverse() @ poses[0] for w in solution.waiting]
    found_t = np.array([T.t for T in solution.T])
    true_t = np.array([T.t for T in truth])
    scale = float((found_t * true_t).sum() / (true_t**2).sum())
    assert scale > 0.0
    assert np.linalg.norm(found_t / scale - true_t, axis=1).max() < tolerance
    turns = [so3_log(f.R @ t.R.T) for f, t in zip(solution.T, truth, strict=True)]
    assert np.linalg.norm(turns, axis=1).max() < tolerance


def test_what_frames_with_little_parallax_match_wrongly_does_not_turn_those_with_much() -> None:
    found = []
    for bent_px in (0.0, 0.6):
        initialiser = started(prior_of(MOVING))
        for frame in initialiser.waiting[:2]:
            frame.pixels[:, 1] += bent_px * np.sign(frame.pixels[:, 0] - CAMERA.cx)
        solution = initialiser.solve()
        assert solution is not None
        found.append(solution.T)
    for plain, bent in list(zip(*found, strict=True))[2:]:
        assert np.linalg.norm(so3_log(plain.R @ bent.R.T)) < 1e-4
        ways = [T.t / np.linalg.norm(T.t) for T in (plain, bent)]  # the unit is the median depth
        assert np.linalg.norm(ways[0] - ways[1]) < 1e-3


def test_a_confidence_that_is_no_number_costs_its_match(monkeypatch: pytest.MonkeyPatch) -> None:
    prior = prior_of(MOVING)
    decode = prior.decode

    def partly_nan(*arguments: object) -> KnownPair:
        pair = decode(*arguments)
        pair.C[:30] = math.nan
        return pair

    monkeypatch.setattr(prior, "decode", partly_nan)
    assert_poses(started(prior), MOVING, tolerance=0.02)


def test_turning_on_the_spot_never_decides_a_geometry() -> None:
    initialiser = started(prior_of(TURNING))
    assert len(initialiser.waiting) == 5
    assert not initialiser.ready
    assert initialiser.parallax_px < 0.5
    assert initialiser.solve() is None


def test_standing_still_never_decides_a_geometry() -> None:
    initialiser = started(prior_of([Sim3.identity()] * 4))
    assert not initialiser.ready
    assert initialiser.solve() is None


def test_parallax_makes_it_ready_and_not_before() -> None:
    prior = prior_of(MOVING)
    frames = prior.frames(CAMERA)
    initialiser = Initialiser(frames[0], prior.encode(frames[0].image, CAMERA), prior, CONFIG)
    assert initialiser.parallax_px == 0.0
    states = []
    for frame in frames[1:]:
        initialiser.add(frame, prior.encode(frame.image, CAMERA))
        enough = initialiser.parallax_px >= CONFIG.parallax_widths * CAMERA.width
        assert initialiser.ready is enough
        states.append(initialiser.ready)
    assert states[0] is False
    assert states[-1] is True


def test_one_view_alone_is_not_enough_however_large_its_parallax() -> None:
    initialiser = started(prior_of([MOVING[0], MOVING[6]]))
    assert initialiser.parallax_px > CONFIG.parallax_widths * CAMERA.width
    assert not initialiser.ready


def test_of_two_geometries_that_explain_every_match_the_smaller_residual_wins() -> None:
    """Straight over a plane: the rival is 15 degrees off and explains as much."""
    two_pairs = CONFIG.model_copy(update={"points": 400, "pairs": 2})
    assert_poses(started(prior_of(MOVING, flat=True), two_pairs), MOVING, tolerance=0.02)


@pytest.mark.parametrize("flat", [False, True], ids=["relief", "plane"])
def test_the_right_geometry_wins(flat: bool) -> None:
    assert_poses(started(prior_of(CURVED, flat)), CURVED, tolerance=0.015)


def test_the_geometry_has_median_depth_one_and_a_small_residual() -> None:
    solution = started(prior_of(MOVING)).solve()
    assert solution is not None
    assert solution.residual_px < 0.3
    assert solution.focal_sigma == 0.0
    assert solution.camera == CAMERA
    baseline = np.linalg.norm(solution.T[-1].t) / np.linalg.norm(MOVING[-1].t)
    assert baseline == pytest.approx(1.0 / np.median(depth_map(CAMERA, flat=False)), rel=0.1)


def test_an_unknown_focal_length_is_refined() -> None:
    far = [pose((0.03 * i, 0.05 * i, -0.06 * i), (0.1 * i, 0.03 * i, 0.05 * i)) for i in range(6)]
    initialiser = started(prior_of(far, noise_px=0.03), camera=GUESS)
    solution = initialiser.solve()
    assert solution is not None
    assert solution.camera.fx == pytest.approx(CAMERA.fx, rel=0.05)
    assert 0.0 < solution.focal_sigma < 0.05


def test_a_focal_length_that_is_too_uncertain_waits_for_parallax() -> None:
    strict = CONFIG.model_copy(update={"max_focal_sigma": 1e-9})
    prior = prior_of(MOVING[:4])
    assert started(prior, strict, GUESS).solve() is None
    assert started(prior, strict, CAMERA).solve() is not None


def test_far_more_parallax_ends_the_wait_for_the_focal_length() -> None:
    impatient = CONFIG.model_copy(update={"max_focal_sigma": 1e-9, "parallax_widths": 0.005})
    assert started(prior_of(MOVING[:4]), impatient, GUESS).solve() is not None


@pytest.mark.parametrize(
    "limit", [{"min_explained": 1.0}, {"max_depth_sigma": 1e-6}], ids=["explained", "depth"]
)
def test_a_geometry_that_explains_or_knows_too_little_is_refused(limit: dict[str, float]) -> None:
    initialiser = started(prior_of(MOVING, noise_px=0.5), CONFIG.model_copy(update=limit))
    assert initialiser.solve() is None


def test_a_geometry_that_was_refused_is_not_tried_again_before_the_parallax_has_grown() -> None:
    refusing = CONFIG.model_copy(update={"min_explained": 1.0, "parallax_widths": 0.005})
    initialiser = started(prior_of(MOVING[:4], noise_px=0.5), refusing)
    assert initialiser.ready
    assert initialiser.solve() is None
    assert not initialiser.ready
    initialiser.waiting += started(prior_of(MOVING, noise_px=0.5), refusing).waiting[-1:]
    assert initialiser.ready


def test_an_attempt_that_raised_is_made_again_with_the_next_frame(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    initialiser = started(prior_of(MOVING), CONFIG)
    monkeypatch.setattr(Hypotheses, "best", raise_once)
    with pytest.raises(np.linalg.LinAlgError):
        initialiser.solve()
    assert initialiser.ready


def test_a_parallax_that_is_no_number_does_not_hold_up_the_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    prior = prior_of(MOVING)
    frames = prior.frames(CAMERA)
    initialiser = Initialiser(frames[0], prior.encode(frames[0].image, CAMERA), prior, CONFIG)
    with monkeypatch.context() as broken:
        broken.setattr(initialiser_module, "rotation_compensated_parallax_px", lambda *_: math.nan)
        initialiser.add(frames[1], prior.encode(frames[1].image, CAMERA))
    for frame in frames[2:]:
        initialiser.add(frame, prior.encode(frame.image, CAMERA))
    assert initialiser.ready


def raise_once(_: Hypotheses) -> None:
    raise np.linalg.LinAlgError("planted")


def test_nothing_waiting_is_no_solution() -> None:
    prior = prior_of(MOVING)
    frame = prior.frames(CAMERA)[0]
    initialiser = Initialiser(frame, prior.encode(frame.image, CAMERA), prior, CONFIG)
    assert not initialiser.ready
    assert initialiser.solve() is None


def swung(sides_m: list[float], parallax_widths: float = CONFIG.parallax_widths) -> list[bool]:
    """For each position beside the reference, whether the camera has turned back by then."""
    prior = prior_of([Sim3.identity(), *(pose((0, 0, 0), (side, 0.0, 0.0)) for side in sides_m)])
    first, *others = prior.frames(CAMERA)
    config = CONFIG.model_copy(update={"parallax_widths": parallax_widths})
    initialiser = Initialiser(first, prior.encode(first.image, CAMERA), prior, config)
    assert not initialiser.turned_back
    turned_back = []
    for frame in others:
        assert initialiser.add(frame, prior.encode(frame.image, CAMERA))
        turned_back.append(initialiser.turned_back)
    return turned_back


def test_a_camera_that_swings_about_the_reference_has_turned_back_at_its_ends() -> None:
    assert swung([0.1, 0.2, 0.1, 0.01, -0.05, -0.1, -0.17]) == [False] * 6 + [True]


def test_a_camera_that_goes_on_never_turns_back() -> None:
    assert not any(swung([0.1, 0.2, 0.18, 0.3, 0.35, 0.4]))


def test_a_camera_that_hovers_keeps_its_reference() -> None:
    sway = [0.1, 0.01, 0.1, 0.01, -0.1]
    assert any(swung(sway, parallax_widths=0.02))
    assert not any(swung(sway, parallax_widths=0.03))


def test_a_frame_that_does_not_see_the_place_is_turned_away() -> None:
    prior = prior_of(MOVING, blind=(2,))
    frames = prior.frames(CAMERA)
    initialiser = Initialiser(frames[0], prior.encode(frames[0].image, CAMERA), prior, CONFIG)
    assert initialiser.add(frames[1], prior.encode(frames[1].image, CAMERA))
    assert not initialiser.add(frames[2], prior.encode(frames[2].image, CAMERA))
    assert len(initialiser.waiting) == 1


def test_a_frame_that_sees_only_a_corner_of_the_place_is_turned_away() -> None:
    away = pose((0.0, 0.0, 0.0), (1.55, 0.0, 0.0))
    prior = prior_of([Sim3.identity(), away])
    frames = prior.frames(CAMERA)
    initialiser = Initialiser(
        frames[0],
        prior.encode(frames[0].image, CAMERA),
        prior,
        InitialisationConfig(points=6000),
    )
    pair = prior.decode(prior.views[0], prior.views[1])
    assert pair.valid.sum() > 40
    assert not initialiser.add(frames[1], prior.encode(frames[1].image, CAMERA))


class BentPrior(KnownPrior):
    """Every third column's matches lie as far to the right as the scene is deep: as if they
    followed what is in front."""

    confidence = 0.05

    def decode(
        self,
        a: KnownView,
        b: KnownView,
        predicted: npt.NDArray[np.float32] | None = None,
        alone: bool = False,
    ) -> KnownPair:
        pair = super().decode(a, b, predicted, alone)
        pair.matches[:, ::3, 0] += a.depth[:, ::3].astype(np.float32)
        pair.C[:, ::3] *= self.confidence
        return pair


def test_matches_of_low_confidence_do_not_bend_the_start() -> None:
    views = prior_of(MOVING).views
    prior = BentPrior(views, CAMERA)
    assert_poses(started(prior), MOVING, 0.01)
    prior.confidence = 1.0
    with pytest.raises(AssertionError):
        assert_poses(started(prior), MOVING, 0.01)


class UnsurePrior(KnownPrior):
    """Its matches are right, and it is sure of none."""

    def decode(
        self,
        a: KnownView,
        b: KnownView,
        predicted: npt.NDArray[np.float32] | None = None,
        alone: bool = False,
    ) -> KnownPair:
        pair = super().decode(a, b, predicted, alone)
        pair.C *= np.float32(0.01)
        return pair


def test_a_start_without_a_confident_match_takes_what_there_is() -> None:
    assert_poses(started(UnsurePrior(prior_of(MOVING).views, CAMERA)), MOVING, 0.01)


LITTLE_PARALLAX = InitialisationConfig(points=300, pairs=1, parallax_widths=0.3)
"""It asks for more than there is in :data:`MOVING`."""


def mistake(frame: MatchedFrame) -> None:
    """Put every match of ``frame`` a tile to one side or the other."""
    frame.pixels[::2] += (9.0, 0.0)
    frame.pixels[1::2] -= (9.0, 0.0)


@pytest.mark.parametrize("confidence", [1.0, 0.1])
def test_a_frame_that_the_geometry_of_the_others_does_not_explain_takes_no_part(
    confidence: float,
) -> None:
    initialiser = started(prior_of(MOVING, noise_px=0.02), LITTLE_PARALLAX)
    mistake(initialiser.waiting[2])
    initialiser.waiting[2].weights[:] *= confidence
    solution = initialiser.solve()
    assert solution is not None
    assert [frame.frame.index for frame in solution.waiting] == [1, 2, 4, 5, 6]


def test_frames_that_are_sure_of_nothing_take_no_part_where_all_fit_no_geometry() -> None:
    found = []
    for confidence in (1.0, 0.1):
        initialiser = started(prior_of(MOVING, noise_px=0.02), LITTLE_PARALLAX)
        for frame in initialiser.waiting[2:5]:
            mistake(frame)
            frame.weights[:] *= confidence
        solution = initialiser.solve()
        found.append(solution and [frame.frame.index for frame in solution.waiting])
    assert found == [None, [1, 2, 6]]


def test_a_reference_is_left_when_the_newest_frame_is_sure_of_nothing() -> None:
    """And the others have too little parallax."""
    near = [pose((0.0, 0.0, 0.0), (0.002 * i, 0.0, 0.001 * i)) for i in range(4)]
    for confidence in (1.0, 0.1):
        initialiser = started(prior_of(near))
        initialiser.waiting[-1].weights[:] *= confidence
        assert initialiser.solve() is None
        assert initialiser.contradicted == (confidence < 1.0)


@pytest.mark.filterwarnings("error")
def test_a_reference_without_texture_turns_every_frame_away(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(KnownView, "interesting", np.zeros((72, 96), bool))
    prior = prior_of(MOVING)
    frames = prior.frames(CAMERA)
    initialiser = Initialiser(frames[0], prior.encode(frames[0].image, CAMERA), prior, CONFIG)
    assert not initialiser.add(frames[1], prior.encode(frames[1].image, CAMERA))


def test_each_match_starts_from_the_one_before() -> None:
    prior = prior_of(MOVING)
    initialiser = started(prior)
    assert prior.predictions[0] is None
    for prediction, waiting in zip(prior.predictions[1:], initialiser.waiting, strict=False):
        assert prediction is waiting.pair.matches


def test_waiting_frames_are_thinned_and_none_is_forgotten() -> None:
    config = CONFIG.model_copy(update={"max_waiting": 3})
    prior = prior_of(MOVING)
    first, *others = prior.frames(CAMERA)
    initialiser = Initialiser(first, prior.encode(first.image, CAMERA), prior, config)
    thinned = []
    for frame in others:
        assert initialiser.add(frame, prior.encode(frame.image, CAMERA))
        thinned += [each.index for each in initialiser.thin()]
    waiting = [w.frame.index for w in initialiser.waiting]
    assert len(waiting) == 3
    assert sorted(waiting + thinned) == [1, 2, 3, 4, 5, 6]
    assert 6 in waiting
    assert_poses(initialiser, MOVING, tolerance=0.01)


def test_a_calibrated_camera_differs_from_its_guess_only_in_saying_so() -> None:
    assert calibrate(GUESS) == replace(GUESS, calibrated=True)


def test_one_wide_step_that_shows_less_than_half_of_the_reference_decides_a_geometry() -> None:
    wide = [Sim3.identity(), pose((0.01, 0.03, -0.02), (0.95, 0.1, 0.05))]
    initialiser = started(prior_of(wide))
    assert initialiser.waiting[0].observed.mean() < 0.5
    assert_poses(initialiser, wide, 0.03)
