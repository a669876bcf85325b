"""What the estimator solves for: the frame of the map, and what is wrong with each mounting."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import so3_exp

Array = npt.NDArray[np.float64]

SCALE, TURN, SHIFT, CAMERA, DVL, DVL_SCALE, HEADING, LAG, CLOCK = (
    slice(0, 1), slice(1, 4), slice(4, 7), slice(7, 10), slice(10, 13), slice(13, 14),
    slice(14, 15), slice(15, 16), slice(16, 18),
)  # fmt: skip
"""Where each parameter stands in a step [P]."""
P = 18
"""Length of a step."""


@dataclass(frozen=True)
class MetricState:
    """Parameters; a step [P] changes them as :meth:`moved` says."""

    log_scale: float
    """Of metres per map unit."""
    R_nm: Array
    """[3, 3] map to n; a step turns it from the left, so that about z it changes the heading."""
    t_n: Array
    """[3] m, of the map's origin in n."""
    R_bc: Array
    """[3, 3] camera to body; a step turns it from the left."""
    c_b: Array
    """[3] m, the camera's centre in the body; taken as stated."""
    R_bd: Array
    """[3, 3] what is wrong with the DVL's mounting, from its stated body axes to the body's."""
    log_dvl: float = 0.0
    """Of the true velocity over the DVL's: speed of sound and beam geometry."""
    heading: float = 0.0
    """rad, constant error of the compass."""
    lag_s: float = 0.0
    """s by which position fixes are older than they state."""
    late_s: float = 0.0
    """s by which depths and velocities are older than they state, in the middle of the path."""
    late_rate: float = 0.0
    """s by which they grow older in a second."""

    @property
    def scale(self) -> float:
        """Metres per map unit."""
        return float(np.exp(self.log_scale))

    def move(
        self,
        step: Array,  # [P]
    ) -> MetricState:
        """The state after a step."""
        return replace(
            self,
            log_scale=self.log_scale + float(step[SCALE][0]),
            R_nm=_turn(self.R_nm, step[TURN]),
            t_n=self.t_n + step[SHIFT],
            R_bc=_turn(self.R_bc, step[CAMERA]),
            R_bd=_turn(self.R_bd, step[DVL]),
            log_dvl=self.log_dvl + float(step[DVL_SCALE][0]),
            heading=self.heading + float(step[HEADING][0]),
            lag_s=self.lag_s + float(step[LAG][0]),
            late_s=self.late_s + float(step[CLOCK][0]),
            late_rate=self.late_rate + float(step[CLOCK][1]),
        )

    def late_at_s(
        self,
        since_s: Array,  # [N] s after the middle of the path
    ) -> Array:
        """[N] s by which depths and velocities are older than they state."""
        return np.asarray(self.late_s + self.late_rate * since_s)

    def body(
        self,
        R_mc: Array,  # [N, 3, 3] camera to map
        p_m: Array,  # [N, 3] camera centre, map
    ) -> tuple[Array, Array]:
        """Body in n at camera poses: rotations [N, 3, 3] and origins [N, 3] m."""
        R_nb = self.R_nm @ R_mc @ self.R_bc.T
        return R_nb, self.scale * p_m @ self.R_nm.T + self.t_n - R_nb @ self.c_b


def _turn(
    R: Array,  # [3, 3]
    by: Array,  # [3] rad
) -> Array:
    """``R`` turned from the left; most steps turn none, and rotation vectors take their time."""
    return so3_exp(by) @ R if by.any() else R
