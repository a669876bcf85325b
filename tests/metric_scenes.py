"""A metric frame made by hand: 2.5 m a unit, turned and shifted, with sources and an origin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from aquaflow.geometry.similarity import Sim3
from aquaflow.telemetry.world_frame import Origin, SourceReport, WorldFrame

SCALE = 2.5
TURN = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
SHIFT = np.array([12.0, -3.0, 4.5])
SIGMAS = np.array([0.2, 0.3, 0.05, 0.003, 0.002, 0.01, 0.004])
"""Of translation (m), rotation (rad) and log-scale."""
TRONDHEIM = Origin(63.43, 10.39, "gnss", 1.5)
LOOKS_DOWN = Sim3(Rotation.from_euler("y", -90, degrees=True).as_matrix(), np.zeros(3))
SOURCES = (
    SourceReport("bar30", "depth", 480, 3),
    SourceReport("compass", "attitude", 0, 120, "magnetic <disturbance>"),
)


def metric_frame(**changes: object) -> WorldFrame:
    """All that a frame can know; ``changes`` replace fields."""
    frame = WorldFrame(
        T_nm=Sim3(TURN, SHIFT, SCALE),
        covariance=np.diag(SIGMAS**2),
        metric=True,
        level=True,
        north="true north",
        depth_known=True,
        origin=TRONDHEIM,
        T_bc=LOOKS_DOWN,
        scale_source="bar30, compass",
        sources=SOURCES,
    )
    return replace(frame, **changes)  # type: ignore[arg-type]
