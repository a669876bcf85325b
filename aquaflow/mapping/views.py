"""The pictures that the map is optimised against."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_exp


@dataclass
class View:
    """One posed picture."""

    frame_index: int
    image: npt.NDArray[np.uint8]
    """[H, W, 3] RGB."""
    camera: CameraModel
    T_wc: Sim3
    keyframe: int
    """Number of the keyframe that the pose hangs on."""
    robust: bool
    """True for common frames, whose outliers are masked (paper, M)."""
    mask: npt.NDArray[np.bool_] | None = None
    inverse_range: Tensor | None = None
    """[H, W] 1 / range from tracking, in the keyframe's unit: T_wc.scale makes it the world's.
    0 where unknown."""
    range_confidence: Tensor | None = None
    """[H, W] in [0, 1]."""
    moments: tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], int] = field(
        default_factory=lambda: (np.zeros(6), np.zeros(6), 0)
    )
    """Adam's first and second moments of the pose, and its step count."""

    def target(self) -> Tensor:
        """[H, W, 3] float32 in [0, 1]."""
        return torch.from_numpy(self.image).to(torch.float32).div_(255.0)

    def viewmat(self) -> Tensor:
        """[4, 4] world to camera, rigid: the scale of a pose is the scale of its map."""
        R = self.T_wc.R.T
        V = np.eye(4)
        V[:3, :3], V[:3, 3] = R, -R @ self.T_wc.t
        return torch.from_numpy(V).to(torch.float32)

    def K(self) -> Tensor:
        return torch.from_numpy(self.camera.K).to(torch.float32)


BETAS = (0.8, 0.99)
"""Adam's decay rates for poses (ARTDECO, field_notes.md section 2.5)."""


def is_usable(
    gradient: npt.NDArray[np.float64],  # [4, 4]
) -> bool:
    """True if a pose may be moved by this gradient: one NaN would stay in it for good."""
    return bool(np.isfinite(gradient[:3]).all())


def refine_pose(
    view: View,
    gradient: Tensor,  # [4, 4] of the loss with respect to the view matrix
    rate: float,
) -> None:
    """One Adam step of the view's pose on the group; translation moves in units of the map.

    The view matrix V moves by the left tangent: dV = hat(xi) V, so dL/dxi_k = <G, E_k V>.
    """
    V = view.viewmat().numpy().astype(np.float64)
    G = gradient.numpy().astype(np.float64)
    if not is_usable(G):
        return
    M = G[:3] @ V.T
    g = np.array(
        [M[0, 3], M[1, 3], M[2, 3], M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]]
    )
    m, v, count = view.moments
    count += 1
    m = BETAS[0] * m + (1.0 - BETAS[0]) * g
    v = BETAS[1] * v + (1.0 - BETAS[1]) * g * g
    step = (
        -rate * (m / (1.0 - BETAS[0] ** count)) / (np.sqrt(v / (1.0 - BETAS[1] ** count)) + 1e-15)
    )
    view.moments = (m, v, count)
    R_cw = so3_exp(step[3:]) @ V[:3, :3]
    t_cw = so3_exp(step[3:]) @ V[:3, 3] + step[:3]
    # so3_exp(log(R)) puts the product back on the group.
    pose = Sim3(R_cw.T, -R_cw.T @ t_cw, view.T_wc.scale)
    view.T_wc = pose @ Sim3.identity()
