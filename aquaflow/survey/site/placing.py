"""From the optimised joint graph to the numbers of a merged site."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.site.frames import Component, common_move, component_of, log_growth, scale
from aquaflow.survey.site.joining import JudgedLink
from aquaflow.survey.site.joint_graph import JointGraph
from aquaflow.survey.site.manifest import SiteDive
from aquaflow.survey.site.merged_file import KEYFRAME, MergedSite, PlacedSubMap, Rows


def place(
    joint: JointGraph,
    dives: Sequence[SiteDive],
    left_out: dict[str, str],
    judged: Sequence[JudgedLink],
) -> MergedSite:
    """The merged site: every sub-map in its component's world; components by size."""
    components, poses = _components(joint)
    number_of = {
        sub_map: number for number, each in enumerate(components) for sub_map in each.sub_maps
    }
    order = sorted(
        range(len(joint.sub_maps)), key=lambda i: (joint.sub_maps[i].dive, joint.sub_maps[i].number)
    )
    names = [dive.name for dive in dives]
    return MergedSite(
        {dive.name: dive.fingerprint for dive in dives},
        left_out,
        tuple(_describe_component(joint, names, each) for each in components),
        tuple(_sub_map(joint, names, i, number_of[i], poses[i]) for i in order),
        tuple(_link(names, link) for link in judged),
        _keyframes(joint, order, number_of, poses),
    )


def _components(joint: JointGraph) -> tuple[list[Component], list[list[Sim3]]]:
    """The components, the one with the most keyframes first, and T_sc by sub-map."""
    poses = [joint.poses(index) for index in range(len(joint.sub_maps))]
    members: dict[int, list[int]] = {}
    for index in range(len(joint.sub_maps)):
        members.setdefault(joint.component_of(index), []).append(index)
    found = []
    for indices in members.values():
        chosen = [joint.sub_maps[index] for index in indices]
        growth = [
            log_growth([each.start(place) for place in each.places], poses[index])
            for each, index in zip(chosen, indices, strict=True)
        ]
        component, factor = component_of(indices, [each.frame for each in chosen], growth)
        for index in indices:
            poses[index] = [scale(T, factor) for T in poses[index]]
        found.append(component)
    found.sort(key=lambda each: -sum(len(joint.sub_maps[i].places) for i in each.sub_maps))
    return found, poses


def _sub_map(
    joint: JointGraph, names: Sequence[str], index: int, component: int, poses: Sequence[Sim3]
) -> PlacedSubMap:
    sub_map = joint.sub_maps[index]
    T_sn, bent = common_move([sub_map.start(place) for place in sub_map.places], poses)
    return PlacedSubMap(
        names[sub_map.dive], sub_map.number, component, T_sn @ sub_map.frame.T_nm, T_sn,
        len(poses), bent,
    )  # fmt: skip


def _describe_component(
    joint: JointGraph, names: Sequence[str], component: Component
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
        "axes_of": {"dive": names[reference.dive], "sub_map": reference.number},
        "dives": sorted({names[joint.sub_maps[index].dive] for index in component.sub_maps}),
        "keyframes": sum(len(joint.sub_maps[index].places) for index in component.sub_maps),
    }


def _link(names: Sequence[str], judged: JudgedLink) -> dict[str, Any]:
    link = judged.link
    return {
        "a": {"dive": names[judged.dive_a], "keyframe": link.a},
        "b": {"dive": names[judged.dive_b], "keyframe": link.b},
        "verdict": judged.verdict, "inliers": link.inliers, "matched": link.matched,
        "cells": link.cells, "similarity": link.similarity,
    }  # fmt: skip


def _keyframes(
    joint: JointGraph,
    order: Sequence[int],
    number_of: dict[int, int],
    poses: Sequence[Sequence[Sim3]],
) -> Rows:
    """[N] KEYFRAME"""
    rows = [
        (
            sub_map.dive,
            place.number,
            sub_map.number,
            number_of[index],
            place.t_ns,
            T.R,
            T.t,
            T.scale,
        )
        for index in order
        for sub_map in [joint.sub_maps[index]]
        for place, T in zip(sub_map.places, poses[index], strict=True)
    ]
    return np.array(rows, KEYFRAME) if rows else np.zeros(0, KEYFRAME)
