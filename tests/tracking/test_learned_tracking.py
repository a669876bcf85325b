"""The compact prior behind the tracker: a thinned dive keeps its poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aquaflow.config import PriorConfig, SourceConfig
from aquaflow.geometry.alignment import align
from aquaflow.lab.evaluation.trajectory_error import read_tum
from aquaflow.prior.factory import SHIPPED, make_prior
from aquaflow.prior.folder import CARD
from aquaflow.sources import open_recording
from aquaflow.sources.preprocessing import Preparation
from aquaflow.types import Frame
from tests.tracking.tracked_clips import PLACED, run

EVERY = 3
"""Frames from one to the next: nine tenths of a second at walking pace."""


@pytest.fixture(scope="module")
def thinned(small_recording: Path) -> list[Frame]:
    recording = open_recording(small_recording)
    prepare = Preparation(SourceConfig(), recording.camera)
    frames = [prepare(f) for f in recording.frames() if isinstance(f, Frame)]
    return frames[::EVERY]


@pytest.mark.usefixtures("one_thread")
def test_a_thinned_dive_is_tracked_to_a_percent(
    thinned: list[Frame], small_recording: Path
) -> None:
    pytest.importorskip("onnxruntime", reason="pip install 'aquaflow[prior]'")
    if not (SHIPPED / CARD).is_file():
        pytest.skip("aquaflow lab prior train compact makes the weights")
    prior = make_prior(PriorConfig(kind="compact", device="cpu"))
    assert prior.name == "compact"
    tracked = run(thinned, prior=prior).tracked
    assert all(t.frame_class in PLACED for t in tracked)
    truth = read_tum(next(small_recording.rglob("*.tum")))
    first = thinned[0].t_ns
    known = {round(t * 1e3): p for t, p in zip(truth.t_s, truth.positions, strict=True)}
    found, true = [], []
    for t in tracked:
        assert t.T_wc is not None
        found.append(t.T_wc.t)
        true.append(known[round((t.frame.t_ns - first) * 1e-6)])
    moved = align(np.array(found), np.array(true), with_scale=True).T_target_source
    error = np.linalg.norm(moved.apply(np.array(found)) - np.array(true), axis=1)
    length = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    assert np.sqrt((error**2).mean()) < 0.01 * length
