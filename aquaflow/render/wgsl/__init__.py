"""Texts of the kernels in WGSL, which has no include. Without torch: the viewer's page draws with
some of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from importlib import resources

from aquaflow.render import limits


def source(file: str, constants: Mapping[str, float | int] | None = None) -> str:
    """The kernels of ``file``, with what they share in front.

    ``constants``: those that they need beside the renderers' ``limits``, by name.
    """
    return preamble(*_PARTS[file], constants=constants) + _text(file)


def preamble(*parts: str, constants: Mapping[str, float | int] | None = None) -> str:
    """Constants, and the shared files named: what stands before a text of kernels."""
    lines = [
        f"const {name}: {'u32' if isinstance(value, int) else 'f32'} = {value:.9g};"
        for name, value in {**_LIMITS, **(constants or {})}.items()
    ]
    return "\n".join([*lines, *map(_text, parts), ""])


@cache
def _text(file: str) -> str:
    return (resources.files(__name__) / f"{file}.wgsl").read_text()


_NAMES = (
    *("DILATION_PX2", "MAX_ALPHA", "MIN_ALPHA", "MIN_TRANSMITTANCE", "NEAR_PLANE_M"),
    *("MIN_QUAT_NORM_SQ", "MAX_SIGMA_PX", "RADIUS_SIGMAS", "TILE_PX"),
)
_LIMITS: dict[str, float | int] = {
    **{name: getattr(limits, name) for name in _NAMES},
    "LOG2_MIN_ALPHA": math.log2(limits.MIN_ALPHA),
    "LOG2E": math.log2(math.e),
    "LN2": math.log(2.0),
}
_PARTS = {
    "project": ("numbers", "camera", "footprint", "reach"),
    "hits": ("camera", "reach", "scan"),
    "ranges": ("camera",),
    "blend": ("camera",),
    "blend_backward": ("camera",),
    "project_backward": ("camera", "footprint", "add_up"),
    "sort": (),
    "sum": ("scan",),
    "activate": ("step", "add_up"),
    "compose": ("numbers", "step"),
    "loss": ("step",),
    "compose_backward": ("step", "add_up"),
    "adam": ("numbers", "step"),
    "reduce": ("add_up",),
}
"""Files that come before each file of kernels."""
