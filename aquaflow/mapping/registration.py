"""Pose of a view that was never mapped: its picture is aligned with the frozen map.

Gauss-Newton over the six numbers of a left tangent of the view matrix. The derivatives of the
drawing are differences of drawings, each from a pose that moves the picture by a fraction of a
pixel: six drawings and no gradient of the renderer. They are kept while the pose hardly moves, so
that most steps take one drawing where ``optimise.minimise``, which linearises after every step,
would take seven; and the sums over pixels stay on the renderer's device.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from aquaflow.config import OptimiserConfig
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.mapping.scene import Scene
from aquaflow.render.photometric import radial_weight
from aquaflow.render.transfers import pose_in, registration_out
from aquaflow.render.views import View
from aquaflow.water.exposure import log_gain_at, set_log_gain
from aquaflow.water.sunlight import light_at

Array = npt.NDArray[np.float64]

TRIAL_PX = 0.5
"""How far a trial pose moves the picture: far above float32's rounding, less than the width of an
edge."""
ROBUST = 0.05
"""Of full scale; residuals beyond count linearly (Huber). Noise and 8 bits stay below it, fish and
marine snow do not."""
SOLID = 0.5
"""Alpha above which the drawing's range says how far away the scene is."""
FAR_PX = 0.5
"""After a step that moves the picture further, the derivatives are taken again."""
CONVERGED_PX = 0.02
"""A shorter step is the last: what it changes is below 0.01 dB."""
DAMPING = 1e-3
"""Share of the normal matrix's diagonal added to it, for motions that the picture hardly shows."""


def take_light(
    view: View,
    mapped: Sequence[View],  # in the order of their frames
) -> None:
    """Give a view that was never mapped the exposure and the light of its neighbours in time:
    nothing of them is learned from its own picture (the peers do so for exposure)."""
    if mapped:
        set_log_gain(view, log_gain_at(view.frame_index, mapped))
        view.light = light_at(view.frame_index, mapped)


def register(view: View, scene: Scene, config: OptimiserConfig) -> None:
    """Refine the pose of ``view`` photometrically; it stays where no step fits better."""
    if config.heldout_steps == 0 or len(scene.gaussians) == 0:
        return
    pose = _align(_Picture(view, scene), config.heldout_steps)
    R, t = pose[:3, :3], pose[:3, 3]
    # The identity puts a product of rotations back on the group.
    view.T_wc = (Sim3(R.T, -R.T @ t, view.T_wc.scale) @ Sim3.identity()).if_finite()


def _align(picture: _Picture, most_steps: int) -> Array:
    """The view matrix [4, 4] at which the map fits best."""
    fit = picture.fit(picture.view.world_to_camera())
    trial = picture.trial()
    derivatives: Tensor | None = None
    for _ in range(most_steps):
        if derivatives is None:
            derivatives = picture.derivatives(fit, trial)
        step = _gauss_newton_step(fit, derivatives)  # in units of ``trial``
        moved = picture.fit(_move(fit.viewmat, step * trial))
        if not moved.cost < fit.cost:
            break
        fit, moved_px = moved, TRIAL_PX * float(np.abs(step).max())
        if moved_px < CONVERGED_PX:
            break
        if moved_px > FAR_PX:
            derivatives = None
    return fit.viewmat


@dataclass(frozen=True)
class _Registration:
    """The map drawn from one pose, against the picture."""

    viewmat: Array
    """[4, 4] world to camera."""
    image: Tensor
    """[P, 3] the drawing; P pixels."""
    residual: Tensor
    """[P, 3] drawing minus picture."""
    weight: Tensor
    """[P, 3] of the robust least squares."""
    cost: float


class _Picture:
    """The picture of a view, and the map drawn from poses near that of the view."""

    def __init__(self, view: View, scene: Scene) -> None:
        self.view, self._scene = view, scene
        camera = view.camera
        self._target = view.target().reshape(-1, 3)
        weight = radial_weight(camera.height, camera.width, view.device) * view.scene_mask()
        self._weight = weight.reshape(-1, 1)
        self._parameters = scene.seen_from(view, view.viewmat())

    @torch.no_grad()
    def fit(
        self,
        viewmat: Array,  # [4, 4]
    ) -> _Registration:
        """The map from this pose."""
        image = self._draw(viewmat)
        residual = image - self._target
        size = residual.abs()
        beyond = ROBUST / size.clamp_min(ROBUST)  # 1 where it is not beyond
        loss = torch.where(size > ROBUST, ROBUST * (size - 0.5 * ROBUST), 0.5 * size * size)
        cost = float(registration_out((self._weight * loss).sum(dtype=torch.float64)))
        return _Registration(viewmat, image, residual, self._weight * beyond, cost)

    def trial(self) -> Array:
        """[6] steps of the tangent that each move the picture by about ``TRIAL_PX``."""
        shown = self._scene.show(self.view)
        z = shown.z[shown.alpha > SOLID]
        z_median = float(registration_out(z.median())) if len(z) else 1.0
        turn = TRIAL_PX / self.view.camera.fx
        return np.array([turn * z_median] * 3 + [turn] * 3)

    @torch.no_grad()
    def derivatives(
        self,
        fit: _Registration,
        trial: Array,  # [6]
    ) -> Tensor:
        """[6, P, 3] how each trial step of the tangent changes the drawing."""
        steps = np.diag(trial)
        return torch.stack([self._draw(_move(fit.viewmat, step)) - fit.image for step in steps])

    def _draw(
        self,
        viewmat: Array,  # [4, 4]
    ) -> Tensor:
        """[P, 3] the map's colours."""
        where = pose_in(viewmat, self.view.device)
        return self._scene.draw(self.view, self._parameters, where).image.reshape(-1, 3)


def _gauss_newton_step(
    fit: _Registration,
    derivatives: Tensor,  # [6, P, 3]
) -> Array:
    """[6] of the tangent, in units of the trial steps."""
    weighted = (derivatives * fit.weight).reshape(6, -1)
    normal = weighted @ derivatives.reshape(6, -1).T
    gradient = weighted @ fit.residual.reshape(-1)
    found = registration_out(torch.cat([normal, gradient[:, None]], dim=1)).astype(np.float64)
    A, b = found[:, :6], found[:, 6]
    A[np.diag_indices(6)] += DAMPING * A.diagonal() + np.finfo(np.float32).eps
    if not np.isfinite(found).all():
        return np.zeros(6)
    return np.asarray(-np.linalg.solve(A, b))


def _move(
    viewmat: Array,  # [4, 4]
    tangent: Array,  # [6] translation, map units, then rotation, rad; in the camera's axes
) -> Array:
    """[4, 4] ``viewmat`` moved by the left tangent."""
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = so3_exp(tangent[3:]), tangent[:3]
    return motion @ viewmat
