"""From the optimised joint graph to the numbers of a merged site."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from aquaflow.survey.site.frames import Component, common_move, component_of
from aquaflow.survey.site.joint_graph import VERDICTS, JointGraph
from aquaflow.survey.site.merged_file import KEYFRAME, MergedSite, PlacedSubMap, Rows
from aquaflow.tracking.graph.equations import poses_of


def place(
    joint: JointGraph,
    names: Mapping[str, str],
    left_out: dict[str, str],
    before: MergedSite | None = None,
) -> MergedSite:
    """The merged site: every sub-map in its component's world; components by size.

    Args:
        joint: the graph.
        names: of its dives, by fingerprint, in the site's order.
        left_out: names and reasons of the others.
        before: an earlier merge: what has not moved since is taken from it.
    """
    components = _components(joint)
    component_of_sub_map = {
        sub_map: number for number, each in enumerate(components) for sub_map in each.sub_maps
    }
    rank = {fingerprint: number for number, fingerprint in enumerate(names)}
    dives = [rank[fingerprint] for fingerprint in joint.dives]
    order = sorted(
        range(len(joint.sub_maps)),
        key=lambda i: (dives[joint.sub_maps[i].dive], joint.sub_maps[i].number),
    )
    merged = MergedSite(
        {name: fingerprint for fingerprint, name in names.items()},
        left_out,
        tuple(_describe_component(joint, names, each) for each in components),
        (),
        tuple(_links(joint, names)),
        np.concatenate(
            [np.zeros(0, KEYFRAME)]
            + [
                _keyframes(joint, i, dives[joint.sub_maps[i].dive], component_of_sub_map[i])
                for i in order
            ]
        ),
    )
    return _with_sub_maps(merged, joint, order, names, before)


def _components(joint: JointGraph) -> list[Component]:
    """The components, the one with the most keyframes first."""
    found = []
    for indices in joint.components():
        frames = [joint.sub_maps[index].frame for index in indices]
        found.append(component_of(indices, frames, joint.growth(indices))[0])
    return sorted(found, key=lambda each: -sum(len(joint.sub_maps[i].start) for i in each.sub_maps))


def _with_sub_maps(
    merged: MergedSite,
    joint: JointGraph,
    order: Sequence[int],
    names: Mapping[str, str],
    before: MergedSite | None,
) -> MergedSite:
    sub_maps = []
    kept = {} if before is None else {(each.dive, each.number): each for each in before.sub_maps}
    for index in order:
        sub_map = joint.sub_maps[index]
        name = names[joint.dives[sub_map.dive]]
        rows = merged.rows_of(name, sub_map.number)
        known = kept.get((name, sub_map.number))
        if known is not None and before is not None and merged.has_as(before, name, sub_map.number):
            sub_maps.append(known)
            continue
        T_sn, bent = common_move(sub_map.starts, poses_of(rows))
        sub_maps.append(
            PlacedSubMap(
                name, sub_map.number, int(rows["component"][0]), T_sn @ sub_map.frame.T_nm, T_sn,
                len(rows), bent,
            )
        )  # fmt: skip
    return replace(merged, sub_maps=tuple(sub_maps))


def _describe_component(
    joint: JointGraph, names: Mapping[str, str], component: Component
) -> dict[str, Any]:
    frame, reference = component.frame, joint.sub_maps[component.reference]
    origin = frame.origin
    return {
        "unit": frame.unit,
        "metric": bool(frame.metric),
        "scale_sigma": frame.scale_sigma if frame.metric else None,
        "scale_chi": component.scale_chi,
        "level": bool(frame.level),
        "north": frame.north,
        "georeferenced": bool(frame.georeferenced),
        "origin": None
        if origin is None
        else {"latitude_deg": origin.latitude_deg, "longitude_deg": origin.longitude_deg},
        "axes_of": {"dive": names[joint.dives[reference.dive]], "sub_map": reference.number},
        "dives": sorted(
            {names[joint.dives[joint.sub_maps[index].dive]] for index in component.sub_maps}
        ),
        "keyframes": sum(len(joint.sub_maps[index].start) for index in component.sub_maps),
    }


def _links(joint: JointGraph, names: Mapping[str, str]) -> list[dict[str, Any]]:
    columns = ("a", "b", "verdict", "inliers", "matched", "cells", "similarity")
    values = zip(*(joint.links[name].tolist() for name in columns), strict=True)
    ends = zip(*(joint.links[name].tolist() for name in ("node_a", "node_b")), strict=True)
    return [
        {
            "a": {"dive": names[joint.dives[joint.dive_of(node_a)]], "keyframe": a},
            "b": {"dive": names[joint.dives[joint.dive_of(node_b)]], "keyframe": b},
            "verdict": VERDICTS[verdict], "inliers": inliers, "matched": matched, "cells": cells,
            "similarity": similarity,
        }
        for (node_a, node_b), (a, b, verdict, inliers, matched, cells, similarity) in zip(
            ends, values, strict=True
        )
    ]  # fmt: skip


def _keyframes(joint: JointGraph, index: int, dive: int, component: int) -> Rows:
    """[K] KEYFRAME of one sub-map."""
    sub_map = joint.sub_maps[index]
    rows = np.zeros(len(sub_map.start), KEYFRAME)
    rows["dive"], rows["component"] = dive, component
    for name in ("number", "sub_map", "t_ns"):
        rows[name] = sub_map.start[name]
    for name in ("R", "t", "scale"):
        rows[name] = joint.shown[name][sub_map.nodes]
    return rows
