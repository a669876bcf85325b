"""What is believed of recognitions: two that agree; and where they put the dive."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aquaflow.base.errors.failures import Failures
from aquaflow.base.worker import Worker
from aquaflow.config import TrackingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.keyframes import KeyframeStore, Pointmap
from aquaflow.telemetry.world_frame import Origin, WorldFrame
from aquaflow.tracking.base import Base, BaseLink, InBase, agree, fit_sub_map, link_covariance
from tests.tracking.tracking_scenes import KnownView

CAMERA = CameraModel(4, 3, 4.0, 4.0, 2.0, 1.5)
T_SM = Sim3(so3_exp(np.array([0.3, -0.2, 1.0])), np.array([4.0, -2.0, 0.5]), 1.7)
NOISE = np.full(7, 0.002)


def pose_of(number: int) -> Sim3:
    return Sim3(so3_exp(np.array([0.0, 0.02 * number, 0.01])), np.array([0.5 * number, 0.1, 0.0]))


def link_of(number: int, T_sm: Sim3 = T_SM, seed: int = 0, sub_map: int = 0) -> BaseLink:
    rng = np.random.default_rng([seed, number])
    T_sk = T_sm @ pose_of(number) @ Sim3.exp(rng.normal(size=7) * NOISE)
    return BaseLink(number, 100 + number, sub_map, T_sk, link_covariance(np.diag(NOISE**2)), 80)


def in_base(frame: WorldFrame | None = None, count: int = 12) -> InBase:
    store = KeyframeStore()
    for number in range(count):
        view = KnownView(CAMERA, pose_of(number), np.ones((3, 4)))
        store.add(number, number * 10**9, view, pose_of(number), Pointmap.unknown(CAMERA), 0)
    frames = {} if frame is None else {0: frame}
    base = Base(Path("yesterday"), "", (), lambda number: pytest.fail("nothing is read"), frames)
    return InBase(base, store, TrackingConfig(), Worker(), Failures())


def apart(a: Sim3, b: Sim3) -> float:
    return float(np.abs((a.inverse() @ b).log()).max())


def test_one_recognition_alone_is_not_believed() -> None:
    dive = in_base()
    dive.add(link_of(3))
    assert not dive.recognised
    assert dive.frame(0, WorldFrame.unknown()).site == ""


def test_two_that_agree_place_the_dive() -> None:
    dive = in_base()
    dive.add(link_of(3))
    dive.add(link_of(4))
    assert dive.first is not None
    assert dive.first.frame == 4
    assert dive.has_news()
    assert not dive.has_news()
    assert apart(dive.places()[0].T_sm, T_SM) < 0.02
    frame = dive.frame(0, WorldFrame.unknown())
    assert frame.site == "yesterday"
    assert frame.unit == "map units"


def test_two_that_contradict_each_other_are_not_believed() -> None:
    dive = in_base()
    dive.add(link_of(3))
    dive.add(link_of(4, Sim3(T_SM.R, T_SM.t + np.array([1.5, 0.0, 0.0]), T_SM.scale)))
    assert not dive.recognised


def test_the_same_keyframe_twice_is_no_agreement() -> None:
    dive = in_base()
    dive.add(link_of(3))
    dive.add(link_of(3))
    assert not dive.recognised


def test_links_to_parts_of_the_base_that_never_met_are_no_agreement() -> None:
    dive = in_base()
    dive.add(link_of(3))
    dive.add(link_of(4, sub_map=1))
    assert not dive.recognised


@settings(max_examples=25)
@given(st.integers(0, 10_000), st.integers(0, 6))
def test_false_candidates_among_true_ones_are_refused(seed: int, false: int) -> None:
    rng = np.random.default_rng(seed)
    dive, numbers = in_base(), rng.permutation(12)
    wrong = set(numbers[:false].tolist())
    for number in range(12):
        elsewhere = Sim3(
            so3_exp(rng.normal(size=3)), rng.uniform(-20, 20, 3), float(np.exp(rng.normal()))
        )
        dive.add(link_of(number, elsewhere if number in wrong else T_SM, seed))
    assert {link.keyframe for link in dive.links} == set(range(12)) - wrong
    assert apart(dive.places()[0].T_sm, T_SM) < 0.02


def test_more_that_agree_overrule_two_that_were_believed() -> None:
    dive = in_base()
    false = Sim3(T_SM.R, T_SM.t + np.array([9.0, 0.0, 0.0]), T_SM.scale)
    for number in (0, 1):
        dive.add(link_of(number, false))
    for number in range(2, 6):
        dive.add(link_of(number))
    assert [link.keyframe for link in dive.links] == [2, 3, 4, 5]
    assert apart(dive.places()[0].T_sm, T_SM) < 0.02


def test_what_the_path_may_have_drifted_is_no_contradiction() -> None:
    drifted = Sim3(T_SM.R, T_SM.t + np.array([0.3, 0.0, 0.0]), T_SM.scale)
    a, b = link_of(0), link_of(8, drifted)
    assert agree(a, pose_of(0), b, pose_of(8), travelled=10.0)
    assert not agree(a, pose_of(0), b, pose_of(8), travelled=0.5)


def test_links_that_scatter_more_than_they_state_place_the_dive_less_surely() -> None:
    quiet = [link_of(number) for number in range(6)]
    moved = [Sim3(T_SM.R, T_SM.t + 0.1 * (-1) ** n, T_SM.scale) for n in range(6)]
    loud = [link_of(number, moved[number]) for number in range(6)]
    poses = [pose_of(number) for number in range(6)]
    assert (
        fit_sub_map(loud, poses).covariance[0, 0] > 2.0 * fit_sub_map(quiet, poses).covariance[0, 0]
    )


def test_the_metric_frame_of_the_base_is_that_of_the_dive() -> None:
    T_ns = Sim3(so3_exp(np.array([0.0, 0.0, 0.5])), np.array([1.0, 2.0, 12.0]), 0.8)
    origin = Origin(60.0, 5.0, "gnss", 1.5)
    sigma = np.diag(np.full(7, 0.05) ** 2)
    known = WorldFrame(T_ns, sigma, True, True, "true north", True, origin, scale_source="dvl")
    dive = in_base(known)
    for number in (3, 4, 5):
        dive.add(link_of(number))
    frame = dive.frame(0, WorldFrame.unknown())
    assert frame.metric
    assert frame.georeferenced
    assert frame.origin == origin
    assert frame.scale_source == "yesterday: dvl"
    assert apart(frame.T_nm, T_ns @ T_SM) < 0.02
    assert frame.scale_sigma > 0.05  # that of the base, and that of the place in it
