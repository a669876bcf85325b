"""The prior without a network: candidate flows, confidence, pointmaps, and lazy work."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.prior import homography
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.prior.flow import CONFIDENCE_SIGMA_PX, FlowMatcher, ImageFlow, pixel_grid, sample
from aquaflow.prior.flow_pair import FlowPair, best_flow
from tests.prior.textured_pictures import (
    HEIGHT,
    WIDTH,
    Picture,
    lookup,
    mapped,
    moved_pair,
    pixel_centres,
    rgb,
    shift,
    texture,
)

CAMERA = CameraModel(WIDTH, HEIGHT, 200.0, 200.0, 120.0, 90.0)
T_BA = Sim3(so3_exp(np.array([0.01, -0.04, 0.02])), np.array([-0.12, 0.02, 0.03]))


def pair_of(a: Picture, b: Picture, predicted: npt.NDArray[np.float32] | None = None) -> FlowPair:
    prior = ClassicalPrior()
    return prior.decode(prior.encode(a, CAMERA), prior.encode(b, CAMERA), predicted)


def relief_depth() -> npt.NDArray[np.float64]:
    """[H, W] smooth hills in a's frame, depth 0.8 to 1.6."""
    grid = pixel_centres()
    x, y = grid[..., 0] / WIDTH, grid[..., 1] / HEIGHT
    return 1.2 + 0.25 * np.sin(5.0 * x + 1.0) + 0.15 * np.cos(6.0 * y + 2.0 * x)


def relief_pair() -> tuple[Picture, Picture, npt.NDArray[np.float64]]:
    """Two views of the hills, and where each pixel of a is seen in b."""
    grid = pixel_centres()
    X = CAMERA.unproject(grid) * relief_depth()[..., None]
    matches = CAMERA.project(T_BA.apply(X))
    # b's texture coordinates by fixed point of p = q - (match(p) - p).
    source = grid.copy()
    for _ in range(30):
        source = grid - sample((matches - grid).astype(np.float32), source.astype(np.float32))
    field = texture(3)
    return rgb(lookup(field, grid)), rgb(lookup(field, source)), matches


@pytest.fixture(scope="module")
def relief() -> tuple[FlowPair, npt.NDArray[np.float64]]:
    a, b, matches = relief_pair()
    return pair_of(a, b), matches


Relief = tuple[FlowPair, npt.NDArray[np.float64]]


def test_matches_follow_the_scene(relief: Relief) -> None:
    pair, matches = relief
    error = np.linalg.norm(pair.matches - matches, axis=-1)[pair.valid]
    assert pair.valid.mean() > 0.6
    assert np.median(error) < 0.15


def test_matches_back_undo_the_matches(relief: Relief) -> None:
    pair, _ = relief
    there = pair.matches
    again = sample(pair.matches_back, there)
    error = np.linalg.norm(again - pixel_centres(), axis=-1)[pair.valid]
    assert error.max() < 1.01
    back_error = np.linalg.norm(sample(there, pair.matches_back) - pixel_centres(), axis=-1)
    assert pair.valid_back.mean() > 0.6
    assert back_error[pair.valid_back].max() < 1.01


def test_the_confidence_is_one_for_a_perfect_match_and_zero_for_none(relief: Relief) -> None:
    pair, _ = relief
    assert pair.C.min() == 0.0
    assert pair.C.max() <= 1.0
    assert not pair.C[~pair.valid].any()
    by_error = np.exp(-0.5 * (pair.flow.error / CONFIDENCE_SIGMA_PX) ** 2)
    assert (by_error + 1e-6 >= pair.C).all()  # edges of the flow take away more


def test_flow_alone_knows_no_ranges(relief: Relief) -> None:
    pair, _ = relief
    assert not ClassicalPrior.ranged
    assert pair.X_a is pair.X_b is pair.Q_a is pair.Q_b is None


@pytest.mark.parametrize("value", [0, 128, 255])
def test_pictures_of_one_colour_give_no_matches(value: int) -> None:
    flat = np.full((HEIGHT, WIDTH, 3), value, np.uint8)
    pair = pair_of(flat, flat)
    assert not pair.valid.any()
    assert not pair.C.any()
    assert np.isfinite(pair.matches).all()


def test_a_picture_of_one_colour_is_not_interesting() -> None:
    encoding = ClassicalPrior().encode(np.full((HEIGHT, WIDTH, 3), 80, np.uint8), CAMERA)
    assert not encoding.interesting.any()
    textured = ClassicalPrior().encode(moved_pair(shift(0, 0))[0], CAMERA)
    assert textured.interesting.mean() > 0.9


def test_the_homography_start_rescues_a_shift_of_thirty_percent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    move = (0.3 * WIDTH, 10.0)
    pictures = moved_pair(shift(*move))
    rescued = pair_of(*pictures)
    assert rescued.valid.mean() > 0.5
    error = rescued.matches - pixel_centres() - np.array(move)
    assert np.median(np.linalg.norm(error, axis=-1)[rescued.valid]) < 0.1

    monkeypatch.setattr(homography, "homography", lambda *_: None)
    assert pair_of(*pictures).valid.mean() < 0.3


def test_a_good_prediction_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("SIFT ran though the prediction was good")

    monkeypatch.setattr(homography, "detect", refuse)
    H = np.array([[1.0, -0.05, 60.0], [0.05, 1.0, 4.0], [0.0, 0.0, 1.0]])
    predicted = mapped(H, pixel_centres()).astype(np.float32)
    pair = pair_of(*moved_pair(H), predicted)
    assert pair.valid.mean() > 0.5


def test_a_wrong_prediction_does_no_harm() -> None:
    pictures = moved_pair(shift(3.0, 1.0))
    wrong = (pixel_centres() + np.array([120.0, -70.0])).astype(np.float32)
    pair = pair_of(*pictures, wrong)
    assert pair.valid.mean() > 0.8


def test_a_wrong_prediction_without_a_homography_falls_back_to_plain_flow(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(homography, "homography", lambda *_: None)
    wrong = (pixel_centres() + np.array([120.0, -70.0])).astype(np.float32)
    assert pair_of(*moved_pair(shift(3.0, 1.0)), wrong).valid.mean() > 0.8


def test_nothing_that_is_masked_is_matched_or_a_keypoint() -> None:
    a, b = (picture.copy() for picture in moved_pair(shift(6.0, 0.0)))
    a[:40, :80] = b[:40, :80] = a[-40:, -80:]
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[:40, :80] = False
    prior = ClassicalPrior()
    free, masked = (
        [prior.encode(picture, CAMERA, each) for picture in (a, b)] for each in (None, mask)
    )
    assert prior.decode(*free).valid[:30, :70].mean() > 0.5, "the display stands still"
    pair = prior.decode(*masked)
    assert not pair.valid[~mask].any()
    assert not masked[0].interesting[~mask].any()
    rows, columns = (masked[0].keypoints.pixels[:, ::-1] - 0.5).astype(int).T
    assert not ((rows < 38) & (columns < 78)).any()
    beside = pair.valid & mask
    assert beside.mean() > 0.5
    moved = pair.matches[beside] - pixel_grid(HEIGHT, WIDTH)[beside]
    assert np.median(np.abs(moved - (6.0, 0.0))) < 0.2
    assert prior.unpack(prior.pack(masked[0]), CAMERA).mask is mask


def test_keypoints_are_found_once_per_picture_and_only_when_needed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls = []
    detect = homography.detect

    def counted(
        grey: npt.NDArray[np.uint8], mask: npt.NDArray[np.bool_] | None = None
    ) -> homography.Keypoints:
        calls.append(grey)
        return detect(grey, mask)

    monkeypatch.setattr(homography, "detect", counted)
    prior = ClassicalPrior()
    a, b = (prior.encode(image, CAMERA) for image in moved_pair(shift(0.3 * WIDTH, 0.0)))
    near = prior.encode(moved_pair(shift(2.0, 0.0))[1], CAMERA)
    prior.decode(a, near)
    assert len(calls) == 0
    prior.decode(a, b)
    prior.decode(b, a)
    prior.decode(a, b)
    assert len(calls) == 2


def test_decoding_twice_gives_the_same_bit_for_bit() -> None:
    pictures = moved_pair(shift(0.3 * WIDTH, 10.0))
    first, second = pair_of(*pictures), pair_of(*pictures)
    np.testing.assert_array_equal(first.matches, second.matches)
    np.testing.assert_array_equal(first.valid, second.valid)


def test_the_classical_prior_claims_no_metres_and_no_descriptors() -> None:
    assert ClassicalPrior.metric is False
    pair = pair_of(*moved_pair(shift(2.0, 0.0)))
    assert pair.D_a is None
    assert pair.D_b is None


def flow_by(dx: float, error: float, columns: int) -> ImageFlow:
    """All pixels move by ``dx``, with the same forward-backward error; the first columns count."""
    forward = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    forward[..., 0] = dx
    valid = np.arange(WIDTH) < columns
    return ImageFlow(
        forward,
        -forward,
        np.full((HEIGHT, WIDTH), error, np.float32),
        np.broadcast_to(valid, (HEIGHT, WIDTH)).copy(),
    )


@pytest.mark.parametrize("right_first", [True, False])
def test_of_flows_a_tile_apart_the_surer_one_is_taken_though_it_matches_less(
    right_first: bool,
) -> None:
    a = ClassicalPrior().encode(rgb(texture(0)[:HEIGHT, :WIDTH]), CAMERA)
    right, a_tile_off = flow_by(24.0, 0.1, WIDTH // 4), flow_by(0.0, 0.7, WIDTH // 3)
    found = iter([right, a_tile_off] if right_first else [a_tile_off, right])

    def matcher(*_: Any) -> ImageFlow:
        return next(found)

    assert best_flow(cast(FlowMatcher, matcher), a, a, [None, None]) is right
