"""What became of keys that a config had in earlier releases; understood for one release."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from copy import deepcopy
from typing import Any

from aquaflow.config.stage import StageConfig, changed_in_the_lab

log = logging.getLogger(__name__)

CONSTANTS: dict[str, Any] = {
    "tracking.gate.duplicate_widths": 0.3 / 480.0,
    "tracking.gate.static_share": 0.8,
    "tracking.gate.min_snr": 2.0,
    "tracking.gate.min_usable": 0.05,
    "tracking.gate.dark_level": 20.0,
    "tracking.gate.blur_loss": 0.065,
    "tracking.gate.blur_memory": 9,
    "tracking.monitor.witnesses": 5,
    "tracking.monitor.sigmas": 5.0,
    "tracking.monitor.min_inlier_share": 0.5,
    "tracking.monitor.rigid_share": 0.8,
    "tracking.monitor.usual_share": 0.65,
    "tracking.crowd_look_loss": 0.05,
    "tracking.return_share": 0.75,
    "tracking.return_widths": 0.03,
    "tracking.min_seen": 0.55,
    "tracking.keyframe_overlap": 0.5,
    "tracking.crowd_overlap": 0.6,
    "tracking.recovered_support": 0.2,
    "tracking.learned.least_triangulated": 0.3,
    "tracking.graph.corroboration": 2,
    "tracking.graph.link_scale_sigma": 0.005,
    "mapping.insertion.covered_alpha": 0.6,
    "mapping.insertion.scale_of_spacing": 0.6,
    "mapping.insertion.max_spacing_widths": 0.1,
    "mapping.insertion.known_sigma": 0.15,
    "mapping.optimiser.newest_share": 0.2,
    "mapping.medium.max_gradient": 0.01,
    "mapping.optimiser.prune_radius_widths": 0.5,
    "mapping.decoder.feature_rate": 4e-3,
    "service.limits.gpu_memory_share": 0.05,
    "viewer.picture_width": 240,
}
"""Settings of before that are constants now, and their values."""
GONE: dict[str, str] = {
    "mapping.medium.priors.grey_world": "it made the water worse on every clip",
    "mapping.medium.priors.white_backscatter": "it made the water worse on every clip",
}
"""Settings of before whose code went, and why."""
FROM_THE_LAB = "set `lab: true` in the file to keep it from the next release on"


def understood(model: type[StageConfig], data: Mapping[str, Any], origin: str) -> dict[str, Any]:
    """A user's ``data`` as ``model`` takes it: keys of before are taken out, and a logged sentence
    for each says what became of it, where the file wants another value than there is now."""
    current = without_old_keys(data, origin)
    if not current.get("lab"):
        for path in changed_in_the_lab(model, current):
            log.warning(
                "%s: '%s' is a switch of the lab now, no setting of a dive; it is used: %s",
                origin, path, FROM_THE_LAB,
            )  # fmt: skip
    return current


def without_old_keys(data: Mapping[str, Any], origin: str) -> dict[str, Any]:
    """``data`` without keys of before; a logged sentence for each whose value is not used."""
    current = deepcopy(dict(data))
    for path, value in _taken_out(current, CONSTANTS):
        if value != CONSTANTS[path]:
            log.warning(
                "%s: '%s' is a constant now, %s; the file's %s is not used",
                origin, path, CONSTANTS[path], value,
            )  # fmt: skip
    for path, value in _taken_out(current, GONE):
        if value:
            log.warning("%s: '%s' is no key any more and not used: %s", origin, path, GONE[path])
    return current


def _taken_out(data: dict[str, Any], paths: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Remove each of ``paths`` that is in ``data``; the path and its value."""
    for path in paths:
        *stages, key = path.split(".")
        below: Any = data
        for stage in stages:
            below = below.get(stage) if isinstance(below, dict) else None
        if isinstance(below, dict) and key in below:
            yield path, below.pop(key)
