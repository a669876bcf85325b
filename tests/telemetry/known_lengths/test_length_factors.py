"""Known lengths in the estimator."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.config import FusionConfig
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.estimator import estimate
from aquaflow.telemetry.factors import length_factors
from aquaflow.telemetry.known_lengths.known_length import KnownLength
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.telemetry.world_frame import WorldFrame

SCALE = 2.05


def measured(
    source: str, length_m: float, sigma_m: float, count: int = 1, wrong: float = 1.0
) -> list[KnownLength]:
    """``count`` measurements to 0.1 % each."""
    rng = np.random.default_rng(count)
    sizes = length_m / SCALE * wrong * np.exp(0.001 * rng.standard_normal(count))
    return [KnownLength(k, source, s, 0.001 * s, length_m, sigma_m) for k, s in enumerate(sizes)]


def frame_by(*lengths: KnownLength) -> WorldFrame:
    t_s = np.arange(20.0)
    path = CameraPath(t_s, np.tile(np.eye(3), (20, 1, 1)), np.outer(t_s, [0.1, 0.0, 0.0]))
    factors = length_factors(lengths)
    points = np.zeros((0, 3))
    return estimate(Telemetry(), path, FusionConfig(), None, lambda: points, factors).frame


def test_a_known_length_alone_gives_the_scale_and_nothing_else() -> None:
    frame = frame_by(*measured("marker 7", 0.2, 0.002))
    assert frame.metric
    assert not frame.level
    assert frame.north == "first keyframe"
    assert frame.T_nm.scale == pytest.approx(SCALE, rel=0.01)
    assert frame.scale_sigma == pytest.approx(np.hypot(0.01, 0.001), rel=0.02)
    assert frame.scale_source.startswith("known length 'marker 7'")


def test_many_measurements_do_not_make_a_ruler_better() -> None:
    frame = frame_by(*measured("laser dots", 0.1, 0.001, 100))
    assert frame.scale_sigma == pytest.approx(0.01, rel=0.02)
    (report,) = frame.sources
    assert (report.source, report.kind, report.used) == ("laser dots", "length", 100)


def test_lengths_that_were_measured_apart_make_each_other_better() -> None:
    frame = frame_by(*measured("marker 7", 0.2, 0.002), *measured("scale bar", 1.0, 0.01))
    assert frame.scale_sigma < 0.009


def test_a_measurement_that_contradicts_the_others_is_rejected() -> None:
    lengths = measured("laser dots", 0.1, 0.001, 20)
    lengths[7] = measured("laser dots", 0.1, 0.001, wrong=1.5)[0]
    frame = frame_by(*lengths)
    (report,) = frame.sources
    assert (report.used, report.rejected) == (19, 1)
    assert frame.T_nm.scale == pytest.approx(SCALE, rel=0.02)
