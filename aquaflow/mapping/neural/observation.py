"""The observation condition o = [v, d]: from where, and how far, a Gaussian is seen.

Paper, Eq. 5 and 6. Gradients stop here: through the highest octave a step of the optimiser would
move Gaussians and cameras only to change the decoder's input.
"""

from __future__ import annotations

import torch
from torch import Tensor

from aquaflow.render.encoding import BANDS, sinusoidal_encoding

FURTHEST = 16.0
"""Distances beyond count as this, in scene scales: sixteen times the usual range, the water is
opaque by then, and the encoding stays bounded."""

NEAREST = 1e-6
"""Distance, in scene scales, below which there is no direction: v is shorter than one."""


def encoded_width(distance: bool) -> int:
    """Numbers that :func:`encoded_observation` gives for each Gaussian."""
    return (4 if distance else 3) * (1 + 2 * BANDS)


@torch.no_grad()
def observation(
    means: Tensor,  # [V, 3] world, map units
    centre: Tensor,  # [3] or [V, 3] world, camera centre
    scene_scale: float = 1.0,
) -> Tensor:
    """[V, 4] unit direction from camera to Gaussian and distance in ``scene_scale`` map units.

    A place that is not finite gives numbers that are not finite; :func:`is_sound` finds them.
    """
    ray = (means - centre) / scene_scale
    d = torch.linalg.vector_norm(ray, dim=-1, keepdim=True)
    return torch.cat([ray / d.clamp_min(NEAREST), d.clamp_max(FURTHEST)], dim=-1)


def is_sound(
    o: Tensor,  # [V, 4]
) -> Tensor:
    """[V] bool: the observation can be encoded."""
    return torch.isfinite(o.sum(dim=-1))


def encoded_observation(
    o: Tensor,  # [V, 4]
    distance: bool = True,
) -> Tensor:
    """[V, 36] gamma(o) with L = 4; [V, 27] of the direction alone without ``distance``.

    Zeros in place of what is not sound.
    """
    known = torch.where(is_sound(o)[:, None], o, 0.0)
    return sinusoidal_encoding(known if distance else known[:, :3])
