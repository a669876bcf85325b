"""Skips of the tracker (docs/architecture.md#skips): each saves work and changes no pose."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.config import TrackingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.keyframes import KeyframeStore
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.prior.contract import Encoding
from aquaflow.prior.flow_pair import FlowEncoding, FlowPair
from aquaflow.tracking.tracker import Tracker
from aquaflow.types import Frame
from tests.tracking.tracking_scenes import SeaFloor, filmed, lawn_path


class Counting(ClassicalPrior):
    """Counts what it is asked for."""

    def __init__(self) -> None:
        super().__init__()
        self.encoded = self.seeded = 0

    def encode(
        self, image: np.ndarray, camera: CameraModel, mask: np.ndarray | None = None
    ) -> FlowEncoding:
        self.encoded += 1
        return super().encode(image, camera, mask)

    def decode(
        self, a: Encoding, b: Encoding, predicted: np.ndarray | None = None, alone: bool = False
    ) -> FlowPair:
        self.seeded += predicted is not None
        return super().decode(a, b, predicted, alone)


@pytest.fixture(scope="module")
def clip() -> list[Frame]:
    return filmed(SeaFloor(), lawn_path(10, step_m=0.12))


def swum(clip: list[Frame], **settings: bool) -> tuple[Counting, np.ndarray]:
    """The prior that was asked, and the camera centres."""
    prior = Counting()
    tracker = Tracker(prior, KeyframeStore(), TrackingConfig(**settings))
    tracked = [t for frame in clip for t in tracker.track(frame).frames]
    tracked += tracker.finish().frames
    return prior, np.array([t.T_wc.t for t in tracked if t.T_wc is not None])


def test_keyframes_are_encoded_once_unless_told_otherwise(clip: list[Frame]) -> None:
    kept, path = swum(clip)
    again, same_path = swum(clip, reuse_encodings=False)
    assert again.encoded > kept.encoded
    assert np.array_equal(path, same_path)


def test_matching_is_seeded_unless_told_otherwise(clip: list[Frame]) -> None:
    seeded, path = swum(clip)
    bare, other_path = swum(clip, seed_matching=False)
    assert seeded.seeded > bare.seeded  # initialisation seeds its own matching in both
    assert len(path) == len(other_path) == len(clip)
    length = np.linalg.norm(path[-1] - path[0])
    assert np.abs(path - other_path).max() < 0.02 * length
