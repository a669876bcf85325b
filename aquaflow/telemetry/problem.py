"""What the estimator solves: sources as factors, where to start, what is known before."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from aquaflow.telemetry.factors.factor import Factor
from aquaflow.telemetry.state import MetricState
from aquaflow.telemetry.world_frame import Origin, SourceReport

Array = npt.NDArray[np.float64]

OPEN_M, FIXED = 1e4, 1e-3
"""1 sigma of what only telemetry can say (m), and of what is a convention where none does."""
ANY_TURN = np.pi
"""rad, 1 sigma of a turn that nothing is known of."""


@dataclass(frozen=True)
class Carried:
    """What an earlier sub-map of the dive has shown, for the next one."""

    state: MetricState
    """Mountings and the compass's constant error are the same."""
    heading_sigma: float
    """rad, 1 sigma of the compass's error against ``state``'s."""
    place: tuple[float, Array, Array] | None
    """Moment (s), north and east [2] m of the body by dead reckoning, covariance [2, 2] m^2."""
    origin: Origin | None
    true_north: bool
    """True if ``state``'s heading is the compass's error against true north."""


@dataclass
class TelemetryProblem:
    """One sub-map's sources as factors, the state to start from, and what is known before."""

    start: MetricState
    prior: Array
    """[P] 1 sigma of each parameter."""
    factors: list[Factor] = field(default_factory=list)
    reports: list[SourceReport] = field(default_factory=list)
    """Of sources that give no factor."""
    compass: bool = False
    """True if x of n is north."""
    declination_known: bool = False
    """True if the compass's north is the true one, but for its error."""
    level: bool = False
    """True if something measures down."""
    mounted: bool = True
    """False if nothing is known of the camera's mounting."""
    origin: Origin | None = None
    doubt: str = ""
    """Why the scale is less sure than the factors say; empty where it is not."""
