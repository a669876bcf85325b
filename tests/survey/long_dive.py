"""A big finished dive, made in minutes and not mapped for hours:

    python -m tests.survey.long_dive OUT [--gaussians 5000000]

A vehicle goes up and down over lines of 12 m (:mod:`aquaflow.lab.synthetic.survey`); the map is
the seabed itself, some 3,000 Gaussians a square metre, so that the lines grow with the map: 2 km at
five million. A view of 320 px a metre, a kept picture every five, a pose every 5 cm.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import torch

from aquaflow.base.storage.dive_status import DiveState, DiveStatus
from aquaflow.config import Config
from aquaflow.dive.folder import DiveFolder
from aquaflow.dive.frames_csv import FrameRow
from aquaflow.dive.map_file import summarise_water
from aquaflow.dive.metric_outputs import water_in
from aquaflow.dive.placement import GEOREFERENCE, georeference, to_geodetic
from aquaflow.dive.results import medium_json
from aquaflow.dive.trajectory_csv import PoseRow
from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.synthetic.survey import ALTITUDE_M, FPS, SurveyPictures
from aquaflow.lab.synthetic.survey_plan import BETWEEN_LINES_M, LINE_M, SPEED_M_S
from aquaflow.lab.synthetic.water import WATER_TYPES
from aquaflow.mapping.gaussians import raw_colour
from aquaflow.mapping.mapper import Mapper
from aquaflow.render import select_renderer
from aquaflow.render.views import View
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.water.white_balance import WhiteBalance
from tests.metric_scenes import TRONDHEIM, metric_frame

Float = npt.NDArray[np.float32]

WIDTH = 320
"""px, of the pictures."""
SPACING_M = 0.018
"""Between Gaussians."""
MARGIN_M = 0.9
"""Of mapped ground beyond the lines: half of a picture."""
VIEW_EVERY, KEYFRAME_EVERY, PICTURE_EVERY = 20, 100, 100
"""Frames: a metre, and five."""
LOOKS = 10
"""Views by which the ranges are known."""
START_M = 4.0
"""Depth of z = 0 below the surface."""
WATER = "coastal_1C"
BEGAN = datetime(2026, 11, 28, 8, tzinfo=timezone.utc)


def lines_of(gaussians: int) -> int:
    """Lines of the survey whose map has about so many."""
    wide = LINE_M + 2.0 * MARGIN_M
    return max(1, round((gaussians * SPACING_M**2 / wide - 2.0 * MARGIN_M) / BETWEEN_LINES_M) + 1)


def frames_of(lines: int) -> int:
    """Frames that the vehicle takes over them."""
    return int((lines * (LINE_M + BETWEEN_LINES_M) - BETWEEN_LINES_M) / SPEED_M_S * FPS)


def strips(survey: SurveyPictures, lines: int) -> Iterator[dict[str, torch.Tensor]]:
    """The parameters of a map's Gaussians, line by line as a vehicle would insert them."""
    columns = round((LINE_M + 2.0 * MARGIN_M) / SPACING_M)
    rows = round(((lines - 1) * BETWEEN_LINES_M + 2.0 * MARGIN_M) / SPACING_M)
    of_line = round(BETWEEN_LINES_M / SPACING_M)
    for first in range(0, rows, of_line):
        rng = np.random.default_rng([rows, first])
        steps = np.meshgrid(np.arange(columns), np.arange(first, min(first + of_line, rows)))
        x, y = (
            (SPACING_M * (each + rng.uniform(-0.4, 0.4, each.shape)) - MARGIN_M).astype(np.float32)
            for each in steps
        )
        z, radiance = survey.seabed(x, y)
        east, south = (survey.seabed(x + dx, y + dy)[0] - z for dx, dy in ((0.02, 0), (0, 0.02)))
        normal = np.dstack([-east / 0.02, -south / 0.02, np.ones_like(z)]).reshape(-1, 3)
        yield _flat(np.dstack([x, y, z]).reshape(-1, 3), normal, radiance.reshape(-1, 3), rng)


def _flat(
    means: Float,  # [N, 3]
    normals: Float,  # [N, 3] of any length
    colours: Float,  # [N, 3]
    rng: np.random.Generator,
) -> dict[str, torch.Tensor]:
    """Flat Gaussians on a surface."""
    count = len(means)
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    # From z to the normal: half way between both, as a quaternion.
    quats = np.column_stack([1.0 + unit[:, 2], -unit[:, 1], unit[:, 0], np.zeros(count)])
    scales = SPACING_M * np.array([0.7, 0.7, 0.15]) * np.exp(rng.normal(0.0, 0.3, (count, 1)))
    opacity = rng.uniform(0.4, 0.95, (count, 1))
    given = {
        "means": means, "quats": quats, "log_scales": np.log(scales),
        "opacity_logits": np.log(opacity / (1.0 - opacity)),
    }  # fmt: skip
    made = {name: torch.from_numpy(np.asarray(each, np.float32)) for name, each in given.items()}
    return made | {"raw_colours": raw_colour(torch.from_numpy(colours))}


def mapped(survey: SurveyPictures, lines: int) -> Mapper:
    """The finished map of the seabed under so many lines, with its water."""
    mapper = Mapper(Config().mapping, select_renderer("auto"), seed=0)
    parts = list(strips(survey, lines))
    gaussians = mapper.scene.gaussians
    for name in gaussians.NAMES:
        gaussians.parameters[name] = torch.cat([part.pop(name) for part in parts])
    count = len(gaussians.parameters["means"])
    along = np.arange(count) * (frames_of(lines) // KEYFRAME_EVERY + 1) // count
    gaussians.keyframes = torch.from_numpy(along)
    gaussians.local_features = torch.zeros(count, 0)
    water = WATER_TYPES[WATER]
    mapper.medium.set_water(*(torch.tensor(each) for each in (water.beta_a, water.B_inf, water.b)))
    mapper.scene.balance = WhiteBalance(0.8 * ALTITUDE_M, (0.42, 0.36, 0.27), (0.7, 0.95, 1.0), 0.1)
    mapper.medium.active = True
    blank = np.zeros((0, 0, 3), np.uint8)
    mapper.views = [
        View(index, blank, survey.camera, survey.T_wc(index), index // KEYFRAME_EVERY, False)
        for index in range(0, frames_of(lines), VIEW_EVERY)
    ]
    return mapper


def frame_of_survey() -> WorldFrame:
    """Metres, level, on the earth."""
    T_nm = Sim3(np.eye(3), np.array([0.0, 0.0, START_M]), 1.0)
    return replace(metric_frame(), T_nm=T_nm)


def write_long_dive(out: Path, gaussians: int) -> int:
    """Write the dive folder; returns how many Gaussians it has."""
    survey, lines, frame = SurveyPictures(WIDTH), lines_of(gaussians), frame_of_survey()
    count = frames_of(lines)
    poses = [survey.T_wc(index) for index in range(count)]
    folder = DiveFolder(out, Config())
    folder.record(_row(survey, index) for index in range(count))
    folder.write_trajectory([index / FPS for index in range(count)], [frame.pose(T) for T in poses])
    folder.write_path_table(_path_rows(frame, poses))
    folder.write_metric_frames({0: frame}, 0)
    folder.write_json(GEOREFERENCE, georeference({0: frame}, 0) or {})
    folder.write_cameras(survey.camera, None)
    (out / "pictures").mkdir()
    for index in range(0, count, PICTURE_EVERY):
        picture = survey.frame(index).image
        cv2.imwrite(str(out / "pictures" / f"{index:06d}.jpg"), picture[..., ::-1])
    mapper = mapped(survey, lines)
    folder.write_map(mapper)
    water = summarise_water(mapper, most_views=LOOKS)
    folder.write_splats(mapper, water, frame)
    assert water is not None
    folder.write_medium(medium_json(water_in(water, frame.T_nm.scale), frame, 100.0))
    folder.write_json(
        "metrics.json",
        {"complete": True, "frames": count, "unit": "m", "utc_start": BEGAN.isoformat()},
    )
    DiveStatus(DiveState.FINISHED).write(out)
    folder.close()
    return len(mapper.gaussians)


def _row(survey: SurveyPictures, index: int) -> FrameRow:
    is_keyframe, is_view = index % KEYFRAME_EVERY == 0, index % VIEW_EVERY == 0
    kind = "keyframe" if is_keyframe else "mapping" if is_view else "common"
    name = survey.name_of(index)
    return FrameRow(index, name, index / FPS, kind, 0, index // KEYFRAME_EVERY, 0.9)


def _path_rows(frame: WorldFrame, poses: list[Sim3]) -> list[PoseRow]:
    places = np.array([frame.pose(T_mc).t for T_mc in poses])
    on_earth = np.column_stack(to_geodetic(TRONDHEIM, places))
    return [
        PoseRow(
            index, index / FPS, BEGAN + timedelta(seconds=index / FPS), 0, x, y, z, "m", *degrees,
            z, ALTITUDE_M, math.fmod(90.0 + index / 100.0, 360.0), 0.0, 0.0, SPEED_M_S, 0.3, 0.5,
        )
        for index, ((x, y, z), degrees) in enumerate(
            zip(places.tolist(), on_earth.tolist(), strict=True)
        )
    ]  # fmt: skip


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition(":")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--gaussians", type=int, default=5_000_000)
    given = parser.parse_args()
    print(write_long_dive(given.out, given.gaussians), "Gaussians in", given.out)


if __name__ == "__main__":
    main()
