"""A finished dive in metres, by lengths that a person marked in it afterwards.

Everything that leaves a dive is its internal map by ``T_nm``; so a dive whose scale nothing has
measured becomes metric by one factor on its files. A dive that was metric already is left as it is:
its scale came from many measurements, and its origin and depth hang on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError, reason_of
from aquaflow.base.errors.regular_file import open_regular_text
from aquaflow.base.storage.archive import read_arrays_of
from aquaflow.base.storage.atomic import atomic_write, write_json
from aquaflow.base.storage.dive_status import rescaling
from aquaflow.dive import trajectory_csv
from aquaflow.dive.dive import HELD_OUT, METRICS, TRAJECTORY, Dive
from aquaflow.dive.medium import NAME as MEDIUM
from aquaflow.dive.metric_outputs import frame_numbers, position_sigma, speeds_of, worlds_in_words
from aquaflow.dive.ply import PlyGaussians, read_ply, write_ply
from aquaflow.dive.trajectory_csv import PoseRow, write_trajectory_csv
from aquaflow.dive.tum import write_tum
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.coverage.coverage_file import NAME as COVERAGE
from aquaflow.survey.coverage.coverage_file import read_coverage_file
from aquaflow.survey.coverage.coverage_files import write_coverage
from aquaflow.survey.measure.notes import read_notes, scale_notes, write_notes
from aquaflow.telemetry.known_lengths.known_length import KnownLength, LengthScale
from aquaflow.telemetry.metric_file import write_metric_file
from aquaflow.telemetry.world_frame import LARGEST_SCALE_SIGMA, SourceReport, WorldFrame
from aquaflow.water.mounting import Lamp

Array = npt.NDArray[np.float64]

MARKED = "marked by hand"
"""Reason in the report of a length that this module used: it may be replaced by better ones."""


def why_not(frame: WorldFrame | None, scale: LengthScale) -> str | None:
    """Why marked lengths do not rescale a sub-map's files, in a sentence; None if they do."""
    if frame is None:
        return "The dive has no metric.json that names this sub-map; its files keep their unit."
    if scale.relative_sigma > LARGEST_SCALE_SIGMA:
        return f"A scale to {100.0 * scale.relative_sigma:.0f} % is too uncertain for metres."
    if frame.metric and not any(source.reason == MARKED for source in frame.sources):
        apart = 100.0 * (scale.metres_per_unit / frame.T_nm.scale - 1.0)
        return (
            f"The dive's files keep the metres of {frame.scale_source}; the marked lengths say "
            f"{apart:+.1f} %."
        )
    return None


def rescale(dive: Dive, sub_map: int, lengths: Sequence[KnownLength], scale: LengthScale) -> None:
    """Bring the files of a sub-map to metres; ``why_not`` has found nothing against it.

    Raises:
        InputError: a file of the dive cannot be read or written.
    """
    frames, main, folder = dict(dive.metric_frames), dive.main, dive.path
    before = frames[sub_map]
    frames[sub_map] = _metric(before, lengths, scale)
    times = scale.metres_per_unit / before.T_nm.scale
    suffix = "" if sub_map == main else f"_{sub_map}"
    # All is read before anything is written: a damaged file changes none.
    plys = [dive.file(f"{name}{suffix}.ply") for name in ("map", "map_clear")]
    splats = {path: read_ply(path) for path in plys if path.is_file()}
    rows, poses = dive.poses, _poses(dive.file(TRAJECTORY))
    inside = {round(1e9 * row.t_s) for row in rows if row.sub_map == sub_map}
    chosen = np.array([round(1e9 * t) in inside for t in poses[:, 0]], bool)
    poses[chosen, 1:4] *= times
    seen = read_coverage_file(dive.file(COVERAGE)) if dive.has(COVERAGE) else {}
    texts, notes = {}, []
    if sub_map == main:
        dive.require(METRICS)
        notes = scale_notes(read_notes(folder, before), times)
        texts[METRICS] = dive.metrics | frame_numbers(frames[main])
        if dive.medium_facts:
            texts[MEDIUM] = _medium(deepcopy(dive.medium_facts), frames[main], times)
    with rescaling(folder):
        for path, each in splats.items():
            write_ply(path, _scale(each, times))
        table = _rows(rows, sub_map, frames[sub_map], times)
        write_trajectory_csv(folder / trajectory_csv.NAME, table)
        write_tum(
            folder / TRAJECTORY, poses[:, 0], poses[:, 1:4], poses[:, [7, 4, 5, 6]],
            worlds_in_words(frames),
        )  # fmt: skip
        for name, content in texts.items():
            write_json(folder / name, content)
        if sub_map == main:
            _scale_ranges(folder / HELD_OUT, times)
            if notes:
                write_notes(folder, notes, frames[main])
        if sub_map in seen:
            seen[sub_map] = seen[sub_map].rescale(times, frames[sub_map].unit)
            write_coverage(folder, seen, main)
        write_metric_file(folder, frames, main)


def _metric(frame: WorldFrame, lengths: Sequence[KnownLength], scale: LengthScale) -> WorldFrame:
    """The frame in metres; its origin stays the start, by convention."""
    covariance = np.zeros((7, 7))
    covariance[3:6, 3:6] = frame.covariance[3:6, 3:6]
    covariance[6, 6] = scale.relative_sigma**2
    named = ", ".join(sorted({each.source for each in lengths}))
    report = SourceReport(named, "length", scale.used, len(scale.rejected), MARKED)
    others = tuple(source for source in frame.sources if source.reason != MARKED)
    T = frame.T_nm
    return replace(
        frame,
        T_nm=Sim3(T.R, T.t * (scale.metres_per_unit / T.scale), scale.metres_per_unit),
        covariance=covariance,
        metric=True,
        scale_source=f"known length '{named}' ({100.0 * scale.relative_sigma:.2g} %)",
        sources=(*others, report),
    )


def _scale(splats: PlyGaussians, times: float) -> PlyGaussians:
    return splats.transform(Sim3(np.eye(3), np.zeros(3), times))


def _rows(rows: Sequence[PoseRow], sub_map: int, frame: WorldFrame, times: float) -> list[PoseRow]:
    """The table with the sub-map's places in metres, their speeds and sigmas."""
    places = {row.index: times * np.array([row.x, row.y, row.z]) for row in rows}
    members = [row for row in rows if row.sub_map == sub_map]
    t_s = np.array([row.t_s for row in members])
    path = np.array([places[row.index] for row in members]).reshape(-1, 3)
    speeds = dict(zip((row.index for row in members), speeds_of(t_s, path), strict=True))
    found = []
    for row in rows:
        if row.sub_map == sub_map:
            at = places[row.index]
            x, y, z = at.tolist()
            row = replace(  # noqa: PLW2901
                row, x=x, y=y, z=z, unit=frame.unit, speed_m_s=speeds[row.index],
                sigma_position_m=position_sigma(frame, at),
            )  # fmt: skip
        found.append(row)
    return found


def _medium(data: dict[str, Any], frame: WorldFrame, times: float) -> dict[str, Any]:
    """medium.json with rates per metre and ranges in metres."""
    data |= {"scale_source": frame.scale_source, "unit": frame.unit}
    if not data["active"]:
        return data
    per_metre = {"attenuation_per_unit": data, "b": data["backscatter"], "d": data["backscatter"]}
    for name, of in per_metre.items():
        of[name] = [rate / times for rate in of[name]]
    ranges = dict.fromkeys(("range_p5", "range_p95", "map_ply_reference_range"), data)
    for name, of in (ranges | {"near_range": data["restored"]}).items():
        of[name] = None if of[name] is None else times * of[name]
    if data.get("lamp") is not None:  # absent in dives before 2026-11-26
        data["lamp"] = asdict(Lamp.of(data["lamp"]).rescale(times))
    data["attenuation_unit"] = data["units"]["attenuation, b, d"] = "1/m"
    return data


MOST_RANGE_BYTES = 1 << 26
"""Of a range in 4 bytes, for 16 million pixels."""


def _scale_ranges(folder: Path, times: float) -> None:
    for path in sorted(folder.glob("*_range.npz")):
        z = read_arrays_of(path, folders=1, most_bytes=MOST_RANGE_BYTES)["z"]
        with atomic_write(path) as stream:
            np.savez_compressed(stream, z=(times * z.astype(np.float64)).astype(np.float32))


def _poses(path: Path) -> Array:
    """[N, 8] of trajectory.tum."""
    try:
        with open_regular_text(path) as stream:
            return np.loadtxt(stream, np.float64, ndmin=2).reshape(-1, 8)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {path}: {reason_of(error)}; map the dive again") from error
