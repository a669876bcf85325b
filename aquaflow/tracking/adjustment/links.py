"""What tracking measured between keyframes, as a term of a joint adjustment.

A link was solved from thousands of dense matches against depths that many frames were fused into:
it knows more than the anchored points' matches between the same two keyframes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aquaflow.geometry.similarity import Sim3Batch, right_jacobian_inverse
from aquaflow.tracking.adjustment.equations import Array, Index


@dataclass(frozen=True)
class Links:
    """M measured relative poses, T_ab exp(d)."""

    a: Index
    """[M] places among the poses."""
    b: Index
    """[M]"""
    T_ab: Sim3Batch
    """[M]"""
    information: Array
    """[M, 7, 7] of the right tangent."""

    def cost(self, poses: Sim3Batch) -> float:
        """Half the squared differences, in sigmas."""
        r = self._residuals(poses)[0]
        return 0.5 * float(np.einsum("mi,mij,mj->", r, self.information, r))

    def blocks(self, poses: Sim3Batch) -> tuple[Array, Array]:
        """[M, 14, 14] of the normal equations over steps of a and b, and gradients [M, 14]."""
        r, T_ba = self._residuals(poses)
        by_b = right_jacobian_inverse(r)
        J = np.concatenate([-by_b @ T_ba.adjoint(), by_b], axis=2)
        weighted = J.transpose(0, 2, 1) @ self.information
        return weighted @ J, np.asarray((weighted @ r[:, :, None])[:, :, 0])

    def _residuals(self, poses: Sim3Batch) -> tuple[Array, Sim3Batch]:
        T_ba = poses[self.b].inverse() @ poses[self.a]
        return (self.T_ab.inverse() @ T_ba.inverse()).log(), T_ba
