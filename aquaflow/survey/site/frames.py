"""The world of a component of a site: scale, gravity, north and place from the dives that know."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.dive.dive import Dive
from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.telemetry.world_frame import WorldFrame


@dataclass(frozen=True)
class Component:
    """Sub-maps that met, and the world that they are expressed in."""

    frame: WorldFrame
    """Of the world s; ``T_nm`` is the identity. Its axes and origin are those of the sub-map that
    knows most, its scale is the mean of all that are metric."""
    reference: int
    """Index of that sub-map."""
    sub_maps: tuple[int, ...]
    """Indices, the reference first."""
    scale_chi: float | None
    """Root mean square of what the metric sub-maps' scales differ by, in sigmas; None for one."""


def component_of(
    sub_maps: Sequence[int],
    frames: Sequence[WorldFrame],
    growth: Sequence[float],
) -> tuple[Component, float]:
    """The world of the sub-maps ``sub_maps``, the first of which gives the axes.

    Args:
        sub_maps: indices.
        frames: the metric frame of each.
        growth: by each, the logarithm of how much the joint optimisation has enlarged it against
            its own world n.

    Returns:
        The component, and the factor by which the world is yet to be scaled.
    """
    first = frames[0]
    metric = [i for i, frame in enumerate(frames) if frame.metric]
    log_scale, sigma, chi = 0.0, first.scale_sigma, None
    if metric:
        off = np.array([growth[i] for i in metric])
        weights = np.array([frames[i].scale_sigma ** -2 for i in metric])
        log_scale = -float(weights @ off / weights.sum())
        sigma = float(weights.sum() ** -0.5)
        if len(metric) > 1:
            chi = float(np.sqrt(weights @ (off + log_scale) ** 2 / (len(metric) - 1)))
    covariance = first.covariance.copy()
    covariance[6, 6] = sigma**2
    frame = replace(first, T_nm=Sim3.identity(), covariance=covariance, metric=bool(metric))
    return Component(frame, sub_maps[0], tuple(sub_maps), chi), float(np.exp(log_scale))


def frame_of(stated: Mapping[str, Any], dives: Mapping[str, Path]) -> WorldFrame:
    """The world of a component as ``merged.json`` states it: the axes and origin of one dive's
    sub-map, the scale of all. ``dives``: their folders by name.

    Raises:
        InputError: that dive's metric.json is damaged.
    """
    axes = stated["axes_of"]
    folder = dives.get(axes["dive"])
    number = int(axes["sub_map"])
    first = WorldFrame.unknown() if folder is None else Dive(folder).frame_of(number)
    covariance = first.covariance.copy()
    if stated["metric"]:
        covariance[6, 6] = float(stated["scale_sigma"]) ** 2
    return replace(
        first, T_nm=Sim3.identity(), covariance=covariance, metric=bool(stated["metric"])
    )


def log_growth(before: Sim3Batch, after: Sim3Batch) -> float:
    """Mean logarithm of how much poses were enlarged."""
    return float(np.mean(np.log(after.scale / before.scale)))


def common_move(before: Sim3Batch, after: Sim3Batch) -> tuple[Sim3, float]:
    """The similarity nearest to what took each of ``before`` to ``after``, and how much the poses
    are bent: the root mean square distance, in the unit of ``after``, that it leaves."""
    moves = after @ before.inverse()
    mean = moves[:1]
    for _ in range(3):  # converges quadratically, and all lie near to each other
        mean = mean @ Sim3Batch.exp((mean.inverse() @ moves).log().mean(axis=0)[None])
    move = mean.on_group().element(0)
    left = np.linalg.norm(move.apply(before.t) - after.t, axis=1)
    return move, float(np.sqrt(np.mean(np.square(left))))
