"""``in_site.json``: where a dive lies in an earlier one, and what speaks for it; also in words."""

from __future__ import annotations

from typing import Any

import numpy as np

from aquaflow.keyframes import KeyframeStore
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.base.in_base import InBase
from aquaflow.tracking.base.links import BaseLink

FORMAT = 1
"""Raised whenever an older AquaFlow could no longer read the file."""


def in_site(in_base: InBase, keyframes: KeyframeStore) -> dict[str, Any]:
    """The content of ``in_site.json`` (docs/formats.md#in-site)."""
    return {
        "format": FORMAT,
        **in_site_numbers(in_base),
        "sub_maps": {
            str(sub_map): _place(in_base, sub_map, links, keyframes)
            for sub_map, links in sorted(in_base.by_sub_map().items())
        },
    }


def in_site_numbers(in_base: InBase) -> dict[str, Any]:
    """The key ``in_site`` of metrics.json, and of /health."""
    first = in_base.first
    return {
        "site": in_base.base.name,
        "state": "found" if in_base.recognised else "looking",
        "first_frame": None if first is None else first.frame,
        "first_s": None if first is None else first.t_ns * 1e-9,
        "looked_up": in_base.looked_up,
        "links": len(in_base.links),
        "refused": in_base.refused,
        "passed_over": in_base.passed_over,
    }


def in_site_notes(in_base: InBase, keyframes: KeyframeStore) -> list[str]:
    """What the dive came to in the earlier one, for the user; one sentence each."""
    name = in_base.base.name
    if in_base.first is None:
        return [
            f"nothing of {name} was recognised in {in_base.looked_up} keyframes: the dive is in a "
            "frame of its own, as without --in"
        ]
    first = in_base.first
    notes = [
        f"the dive was recognised in {name} at frame {first.frame} ({first.t_ns * 1e-9:.1f} s), by "
        f"{len(in_base.links)} of {in_base.looked_up} keyframes: its files are in the frame of "
        f"{name}"
    ]
    sub_maps = {keyframe.sub_map for keyframe in keyframes.keyframes}
    elsewhere = len(sub_maps - set(in_base.by_sub_map()))
    if elsewhere:
        notes.append(
            f"{elsewhere} of {len(sub_maps)} sub-maps were not recognised in {name}: each of them "
            "is in a frame of its own"
        )
    return notes


def _place(
    in_base: InBase, sub_map: int, links: list[BaseLink], keyframes: KeyframeStore
) -> dict[str, Any]:
    frame = in_base.frame(sub_map, WorldFrame.unknown())
    T, covariance = frame.T_nm, in_base.places()[sub_map].covariance
    return {
        "site_sub_map": links[0].base_sub_map,
        "unit": frame.unit,
        "T_site_dive": {
            "scale": float(T.scale),
            "rotation": T.R.tolist(),
            "translation": T.t.tolist(),
        },
        "sigma": {
            "position_map_units": float(np.sqrt(np.trace(covariance[:3, :3]))),
            "rotation_deg": float(np.degrees(np.sqrt(np.trace(covariance[3:6, 3:6])))),
            "scale": float(np.sqrt(covariance[6, 6])),
        },
        "links": [
            {
                "keyframe": link.keyframe,
                "frame": keyframes[link.keyframe].frame_index,
                "t_s": keyframes[link.keyframe].t_ns * 1e-9,
                "site_keyframe": link.base_keyframe,
                "keypoints": link.inliers,
            }
            for link in links
        ],
    }
