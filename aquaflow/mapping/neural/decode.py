"""View-dependent attributes of Gaussians: initial attributes plus decoded residuals.

One view at a time goes through the compiled kernel; :func:`decoded_torch` is its definition, the
fallback, and what knows a camera for each Gaussian.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.mapping.gaussians.reanchoring import quaternion_product
from aquaflow.mapping.neural.decoder import LOG_SCALE, TURN, Decoder, Trunk, apply_residuals
from aquaflow.mapping.neural.observation import observation
from aquaflow.render.contract import NEAR_PLANE_M
from aquaflow.render.decoding import ViewWeights, decode_view, takes
from aquaflow.render.library import library_or_none
from aquaflow.render.views import View

DECODED = ("quats", "log_scales", "raw_colours")
"""Names of the parameters that get residuals."""

MARGIN = 0.3
"""Share of the picture's size by which a centre may lie outside and still be decoded."""


@torch.no_grad()
def in_picture(
    means: Tensor,  # [N, 3] world
    view: View,
    viewmat: Tensor,  # [4, 4]
) -> Tensor:
    """[N] bool: the Gaussian's centre is in the picture, or not far outside it."""
    x, y, z = (means @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(1)
    camera, front = view.camera, z > NEAR_PLANE_M
    z = torch.where(front, z, 1.0)
    half_width, half_height = 0.5 * camera.width, 0.5 * camera.height
    across = (camera.fx * x / z + camera.cx - half_width).abs()
    down = (camera.fy * y / z + camera.cy - half_height).abs()
    reach = 1.0 + 2.0 * MARGIN
    return front & (across < reach * half_width) & (down < reach * half_height)


def decode(
    decoder: Decoder,
    trunk: Trunk,
    parameters: Mapping[str, Tensor],  # of a GaussianMap
    places: Tensor,  # [V] int64 places of trunk.tokens
    centre: Tensor,  # [3] of the camera
    threads: int,
) -> dict[str, Tensor]:
    """The parameters with residuals on those in ``places``; differentiable but for the places."""
    on_cpu = trunk.hidden.device.type == "cpu"
    library = library_or_none() if on_cpu and takes(decoder.config.width) else None
    if library is None:
        return decoded_torch(decoder, trunk, parameters, places, centre)
    if trunk.sound is not None:
        places = places[trunk.sound[places]]
    weights = ViewWeights(
        decoder.weight_in_heads(),
        torch.cat([decoder.geometry.weight, decoder.colour.weight]),
        torch.cat([decoder.geometry.bias, decoder.colour.bias]),
        decoder.limits,
    )
    quats, log_scales, raw_colours = decode_view(
        (parameters["quats"], parameters["log_scales"], parameters["raw_colours"]),
        trunk.hidden,
        weights,
        trunk.tokens.rows[places],
        places,
        parameters["means"],
        centre,
        threads,
        library,
    )
    changed = {"quats": quats, "log_scales": log_scales, "raw_colours": raw_colours}
    return {**parameters, **changed}


def decoded_torch(
    decoder: Decoder,
    trunk: Trunk,
    parameters: Mapping[str, Tensor],  # of a GaussianMap
    places: Tensor,  # [V] int64
    centre: Tensor,  # [3], or [V, 3]
) -> dict[str, Tensor]:
    """Reference implementation of :func:`decode` in torch."""
    rows = trunk.tokens.rows[places]
    o = observation(parameters["means"].detach()[rows], centre)
    return apply_residuals(parameters, rows, decoder.residuals(trunk, places, o))


def without_residuals(
    wanted: Mapping[str, Tensor],  # DECODED [V, ...], as they are to be seen
    residuals: Tensor,  # [V, 9]
) -> dict[str, Tensor]:
    """The initial attributes that residuals turn into ``wanted``."""
    u, log_scales, colours = residuals.split_with_sizes([TURN, LOG_SCALE, 3], dim=1)
    back = F.normalize(F.pad(-u, (1, 0), value=1.0), dim=1)
    return {
        "quats": quaternion_product(wanted["quats"], back),
        "log_scales": wanted["log_scales"] - log_scales,
        "raw_colours": wanted["raw_colours"] - colours,
    }
