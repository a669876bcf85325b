"""The one map of a site, optimised further on the pictures of all its dives.

Every dive looks at the same Gaussians through its own water and in its own light; the world, the
unit and the light are those of the latest dive. Views and Gaussians follow their keyframes, as the
merge has them. What was held out of the dives is held out here, too, and says what it came to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.base.errors import AquaFlowError, InputError
from aquaflow.dive.dive import Dive
from aquaflow.dive.held_out import spread
from aquaflow.dive.map_file import clear_splats, read_map_file, splats_of
from aquaflow.dive.restored import recorded_pictures, with_picture
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.gaussians import GaussianMap, raw_colour
from aquaflow.mapping.joint_map import JointMap, Member
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.cpu import cpu_renderer
from aquaflow.render.image_metrics import psnr
from aquaflow.render.transfers import picture_out
from aquaflow.render.views import View, ViewStore, in_time
from aquaflow.survey.change.site_map import (
    ComponentDives,
    DayMap,
    MadeMap,
    Part,
    PlacedDive,
    combine,
)
from aquaflow.survey.change.surface import Progress
from aquaflow.survey.export.mesh.view_surfaces import surfaces_of_map
from aquaflow.survey.site.merged_file import MergedSite
from aquaflow.telemetry.metric_file import map_name
from aquaflow.telemetry.world_frame import WorldFrame

MOST_JUDGED = 16
"""Held-out views of a dive that are judged, spread over it: a dozen drawings each, twice."""


@dataclass(frozen=True)
class RefinedDive:
    """What refining came to in the pictures of a dive."""

    name: str
    views: int
    """That were learned from; 0 where the recording is not there."""
    held_out: int
    """Views that were judged."""
    psnr_before: float | None
    """dB, mean of the held-out views; None without any."""
    psnr_after: float | None
    reason: str
    """Why nothing was learned from the dive's pictures; empty where something was."""


@dataclass(frozen=True)
class RefinedMap:
    """The one map after refining."""

    parts: list[Part]
    """In the site's world."""
    dives: list[RefinedDive]
    """In the same order."""
    steps: int
    """Steps that were taken."""


class _JointDive:
    """A dive whose map lies in the joint world u, which is that of the latest dive's map."""

    def __init__(self, placed: PlacedDive, merged: MergedSite, T_us: Sim3) -> None:
        self.placed, main = placed, placed.sub_map
        self.dive = Dive(placed.folder)
        path = placed.folder / map_name(main.number, self.dive.main)
        self.mapper = read_map_file(path, cpu_renderer(self.dive.config.threads))
        if not self.mapper.views or len(self.mapper.gaussians) == 0:
            raise InputError(
                f"the map of {placed.folder} is empty; map a recording that shows more"
            )
        self.mapper.scene.bake(self.mapper.views)
        T_um = T_us @ main.T_sm
        self._T_um, self.scale = T_um, T_um.scale
        self._moves = {
            int(row["number"]): T_us
            @ Sim3(row["R"].copy(), row["t"].copy(), float(row["scale"]))
            @ self.dive.places.by_number[int(row["number"])].T_mc.inverse()
            for row in merged.rows_of(main.dive, main.number)
        }
        numbers = {view.keyframe for view in self.mapper.views}
        numbers |= set(self.mapper.gaussians.keyframes.tolist())
        self._moves |= dict.fromkeys(numbers - self._moves.keys(), T_um)
        self.held_out = self._held_out()
        self.mapper.move(self._moves)

    def _held_out(self) -> list[View]:
        """Views of what was held out, in u, by the poses that tracking gave them."""
        dive, main = self.dive, self.placed.sub_map
        T_mn = dive.frame_of(main.number).T_nm.inverse()
        pose_of = {row: pose for pose, row in enumerate(dive.frame_of_pose.tolist())}
        row_of = {row.index: number for number, row in enumerate(dive.frames)}
        camera, R_nc, found = dive.camera, dive.trajectory.R_wc, list[View]()
        for each in dive.held_out:
            number = row_of.get(each.frame_index, -1)
            if number not in pose_of or dive.frames[number].sub_map != main.number:
                continue
            pose, keyframe = pose_of[number], dive.frames[number].keyframe
            T_mc = T_mn @ Sim3(R_nc[pose], dive.trajectory.positions[pose])
            T_uc = self._moves.get(keyframe or 0, self._T_um) @ T_mc
            found.append(View(each.frame_index, each.real, camera, T_uc, keyframe or 0, False))
        return [found[place] for place in sorted(spread(len(found))[:MOST_JUDGED])]

    def take_pictures(self, store: ViewStore, progress: Progress) -> None:
        """Give the views their pictures.

        Raises:
            InputError: the recording is not there, or another.
        """
        recording = self.dive.recording
        if recording is None:
            raise InputError("its recording is not where it was mapped from")
        views = in_time(self.mapper.views)
        whole = []
        for view, picture in recorded_pictures(self.dive, recording, views):
            whole.append(store.keep(with_picture(view, picture)))
            progress(f"pictures of {self.placed.sub_map.dive}", len(whole), len(views))
        self.mapper.views = whole

    def judge(self) -> float | None:
        """Mean PSNR of the held-out views from refined poses, dB."""
        found = []
        for view in self.held_out:
            judged = with_picture(view, view.image)
            self.mapper.take_light(judged)
            self.mapper.register(judged)
            shown = picture_out(self.mapper.show(judged).image.clamp(0.0, 1.0))
            found.append(psnr(shown, picture_out(judged.target())))
        return float(np.mean(found)) if found else None


def make_refined_map(
    site: Path,
    component: int | None,
    steps: int,
    seconds: float | None,
    work: Path,
    progress: Progress,
) -> tuple[MadeMap, RefinedMap]:
    """As :func:`aquaflow.survey.change.site_map.make_site_map`, refined with at most so many
    ``steps``, in as many ``seconds`` (None: as it takes).

    Raises:
        InputError: the site was never merged, none of the dives is left, or the site cannot be
            written to.
    """
    chosen = ComponentDives(site, component)
    T_us = chosen.placed[-1].sub_map.T_sm.inverse() if chosen.placed else Sim3.identity()

    def look_at(placed: PlacedDive) -> tuple[_JointDive, DayMap]:
        dive = _JointDive(placed, chosen.merged, T_us)
        return dive, _day(dive, work, progress)

    dives, days = zip(*chosen.each(look_at), strict=True)
    refined = _refine(dives, combine(days), steps, Deadline(seconds), work, progress)
    refined = replace(refined, parts=[part.transform(T_us.inverse()) for part in refined.parts])
    return chosen.write(refined.parts), refined


def _refine(
    dives: Sequence[_JointDive],
    parts: Sequence[Part],
    steps: int,
    until: Deadline,
    work: Path,
    progress: Progress,
) -> RefinedMap:
    """The combined ``parts`` refined, in the joint world."""
    members = [
        Member(dive.mapper, dive.scale, part.gains) for dive, part in zip(dives, parts, strict=True)
    ]
    joint = JointMap(_gaussians_of(parts), members)
    reasons = []
    for number, dive in enumerate(dives):
        try:
            dive.take_pictures(ViewStore(work / f"pictures{number}"), progress)
            reasons.append("")
        except AquaFlowError as error:
            reasons.append(str(error))
    before = [dive.judge() for dive in dives]
    learning = [d.mapper for d, reason in zip(dives, reasons, strict=True) if not reason]
    taken = joint.refine(learning, steps, partial(progress, "refining"), until)
    after = [dive.judge() for dive in dives]
    refined = []
    for number, dive in enumerate(dives):
        views = 0 if reasons[number] else len(dive.mapper.views)
        refined.append(
            RefinedDive(
                dive.placed.sub_map.dive, views, len(dive.held_out), before[number],
                after[number], reasons[number],
            )
        )  # fmt: skip
    return RefinedMap(_parts_of(joint, dives[-1].mapper, parts), refined, taken)


def _day(dive: _JointDive, work: Path, progress: Progress) -> DayMap:
    name = dive.placed.sub_map.dive
    shown = partial(progress, f"views of {name}")
    views = surfaces_of_map(dive.mapper, Sim3.identity(), work, shown)
    return DayMap(name, splats_of(dive.mapper), views)


def _gaussians_of(parts: Sequence[Part]) -> GaussianMap:
    """All parts as one set of Gaussians; in place of a keyframe, each has its part's number."""
    whole = GaussianMap()
    for number, part in enumerate(parts):
        splats = part.gaussians
        tensors = {
            "means": splats.means,
            "quats": splats.wxyz,
            "log_scales": np.log(splats.scales),
            "raw_colours": splats.colours,
            "opacity_logits": splats.opacities[:, None],
        }
        new = {name: torch.from_numpy(np.array(t, np.float32)) for name, t in tensors.items()}
        new["opacity_logits"] = torch.logit(new["opacity_logits"], eps=1e-6)
        new["raw_colours"] = raw_colour(new["raw_colours"])
        whole.extend(new, number)
    return whole


def _parts_of(joint: JointMap, latest: Mapper, parts: Sequence[Part]) -> list[Part]:
    """The parts as they are now, in the colours that the latest dive's map is shown in."""
    shown, owners = clear_splats(latest, WorldFrame.unknown()), joint.gaussians.keyframes.numpy()
    return [
        replace(part, gaussians=shown.rows(owners == number)) for number, part in enumerate(parts)
    ]
