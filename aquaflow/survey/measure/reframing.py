"""A finished dive in another frame n: in metres, or level, by what a person marked afterwards.

Everything that leaves a dive is its internal map by ``T_nm``; so a dive whose scale or gravity
nothing has measured gets it by one similarity on its files. What was measured already is left as it
is: it came from many measurements, and the dive's origin and depth hang on it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.base.storage.archive import read_arrays_of
from aquaflow.base.storage.atomic import atomic_write, write_json
from aquaflow.base.storage.dive_status import rescaling
from aquaflow.dive import trajectory_csv
from aquaflow.dive.dive import HELD_OUT, METRICS, TRAJECTORY, Dive
from aquaflow.dive.fixes_csv import NAME as FIXES
from aquaflow.dive.medium import NAME as MEDIUM
from aquaflow.dive.metric_outputs import (
    attitude_of,
    frame_numbers,
    heading_sigma_deg,
    position_sigma,
    speeds_of,
    worlds_in_words,
)
from aquaflow.dive.placement import GEOREFERENCE, georeference
from aquaflow.dive.ply import read_ply, write_ply
from aquaflow.dive.trajectory_csv import PoseRow, write_trajectory_csv
from aquaflow.dive.tum import Trajectory, write_tum
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.coverage.coverage_file import NAME as COVERAGE
from aquaflow.survey.coverage.coverage_file import read_coverage_file
from aquaflow.survey.coverage.coverage_files import write_coverage
from aquaflow.survey.measure.notes import moved_notes, read_notes, write_notes
from aquaflow.survey.measure.reef_numbers import CSV, JSON, write_reef_numbers
from aquaflow.survey.measure.viewpoints import (
    moved_viewpoints,
    read_viewpoints,
    write_viewpoints,
)
from aquaflow.telemetry.known_lengths.known_length import KnownLength, LengthScale
from aquaflow.telemetry.metric_file import write_metric_file
from aquaflow.telemetry.world_frame import (
    LARGEST_SCALE_SIGMA,
    LENGTH,
    MARKED,
    SourceReport,
    WorldFrame,
)
from aquaflow.water.mounting import Lamp

Array = npt.NDArray[np.float64]


def why_not_metric(frame: WorldFrame | None, scale: LengthScale) -> str | None:
    """Why marked lengths do not rescale a sub-map's files, in a sentence; None if they do."""
    if frame is None:
        return "The dive has no metric.json that names this sub-map; its files keep their unit."
    if scale.relative_sigma > LARGEST_SCALE_SIGMA:
        return f"A scale to {100.0 * scale.relative_sigma:.0f} % is too uncertain for metres."
    if frame.metric and not frame.is_marked(LENGTH):
        apart = 100.0 * (scale.metres_per_unit / frame.T_nm.scale - 1.0)
        return (
            f"The dive's files keep the metres of {frame.scale_source}; the marked lengths say "
            f"{apart:+.1f} %."
        )
    return None


def why_not_level(frame: WorldFrame | None) -> str | None:
    """Why a sub-map cannot be turned level, in a sentence; None if it can."""
    if frame is None:
        return "the dive has no metric.json that names its largest sub-map; map it again"
    if frame.site:
        return f"the dive lies in the frame of {frame.site}; make that dive level, and map this one"
    if frame.gravity_measured:
        sigma = np.degrees(frame.tilt_sigma_rad)
        return f"the dive's telemetry has measured gravity, to {sigma:.2g} degrees; it is level"
    return None


def metric(frame: WorldFrame, lengths: Sequence[KnownLength], scale: LengthScale) -> WorldFrame:
    """The frame in metres; its origin stays the start, by convention."""
    covariance = np.zeros((7, 7))
    covariance[3:6, 3:6] = frame.covariance[3:6, 3:6]
    covariance[6, 6] = scale.relative_sigma**2
    named = ", ".join(sorted({each.source for each in lengths}))
    report = SourceReport(named, LENGTH, scale.used, len(scale.rejected), MARKED)
    T = frame.T_nm
    return replace(
        frame,
        T_nm=Sim3(T.R, T.t * (scale.metres_per_unit / T.scale), scale.metres_per_unit),
        covariance=covariance,
        metric=True,
        scale_source=f"known length '{named}' ({100.0 * scale.relative_sigma:.2g} %)",
        sources=_with_marked(frame, report),
    )


def level(
    frame: WorldFrame,
    R_ln: Array,  # [3, 3] from n to the level n
    tilt: Array,  # [2, 2] rad^2, of the turn about x and y of the level n
    report: SourceReport,
) -> WorldFrame:
    """The frame turned about its origin until z points down; ``report``: what says so."""
    covariance = np.zeros((7, 7))
    if frame.metric:
        covariance[:3, :3] = R_ln @ frame.covariance[:3, :3] @ R_ln.T
    covariance[3:5, 3:5] = tilt
    covariance[6, 6] = frame.covariance[6, 6]
    return replace(
        frame,
        T_nm=Sim3(R_ln, np.zeros(3)) @ frame.T_nm,
        covariance=covariance,
        level=True,
        on_ground=False,
        north="initial heading",
        sources=_with_marked(frame, report),
    )


def _with_marked(frame: WorldFrame, report: SourceReport) -> tuple[SourceReport, ...]:
    """The frame's sources, of what is marked by hand the last of its kind alone."""
    others = (each for each in frame.sources if (each.kind, each.reason) != (report.kind, MARKED))
    return (*others, replace(report, reason=MARKED))


def reframe(dive: Dive, sub_map: int, after: WorldFrame) -> None:
    """Bring the files of a sub-map from its metric frame to ``after``.

    The plan view of coverage stays on the plane that it was counted on, which it names.

    Raises:
        InputError: a file of the dive cannot be read or written.
    """
    frames, main, folder = dict(dive.metric_frames), dive.main, dive.path
    before, frames[sub_map] = frames[sub_map], after
    change = after.T_nm @ before.T_nm.inverse()
    times = change.scale
    suffix = "" if sub_map == main else f"_{sub_map}"
    # All is read before anything is written: a damaged file changes none.
    plys = [dive.file(f"{name}{suffix}.ply") for name in ("map", "map_clear")]
    splats = {path: read_ply(path) for path in plys if path.is_file()}
    path, places = _moved(dive, sub_map, change)
    table = _rows(dive.poses, sub_map, after, places)
    seen = read_coverage_file(dive.file(COVERAGE)) if dive.has(COVERAGE) else {}
    texts, notes, viewpoints = {}, [], []
    if sub_map == main:
        dive.require(METRICS)
        notes = moved_notes(read_notes(folder, before), change)
        viewpoints = moved_viewpoints(read_viewpoints(folder, before), change)
        texts[METRICS] = dive.metrics | frame_numbers(after) | {"fixes": None}
        if dive.medium_facts:
            texts[MEDIUM] = _medium(deepcopy(dive.medium_facts), after, times)
    placed = georeference(frames, main)
    if placed is not None:
        texts[GEOREFERENCE] = placed
    with rescaling(folder):
        dive.file(FIXES).unlink(missing_ok=True)  # errors of the frame before
        for ply, each in splats.items():
            write_ply(ply, each.transform(change))
        write_trajectory_csv(folder / trajectory_csv.NAME, table)
        write_tum(folder / TRAJECTORY, path.t_s, path.positions, path.wxyz, worlds_in_words(frames))
        for name, content in texts.items():
            write_json(folder / name, content)
        if sub_map == main:
            _scale_ranges(folder / HELD_OUT, times)
            if notes:
                write_notes(folder, notes, after)
            if viewpoints:
                write_viewpoints(folder, viewpoints, after)
        if sub_map in seen:
            seen[sub_map] = seen[sub_map].rescale(times, after.unit)
            write_coverage(folder, seen, main)
        write_metric_file(folder, frames, main)


def _moved(dive: Dive, sub_map: int, change: Sim3) -> tuple[Trajectory, dict[int, Sim3]]:
    """The dive's path after ``change`` of a sub-map, and that sub-map's T_nc by time, ns.

    Raises:
        InputError: trajectory.tum cannot be read, or lacks a pose of trajectory.csv.
    """
    path = dive.trajectory
    inside = {round(1e9 * row.t_s) for row in dive.poses if row.sub_map == sub_map}
    positions, wxyz, found = path.positions.copy(), path.wxyz.copy(), {}
    for number, (t_s, R) in enumerate(zip(path.t_s, path.R_wc, strict=True)):
        if round(1e9 * t_s) in inside:
            T = change @ Sim3(R, positions[number])
            found[round(1e9 * t_s)] = Sim3(T.R, T.t)
            positions[number], wxyz[number] = T.t, T.quaternion
    if inside - found.keys():
        raise InputError(
            f"{dive.file(TRAJECTORY)} lacks poses of {trajectory_csv.NAME}; map the dive again"
        )
    return Trajectory(path.t_s, positions, wxyz), found


def _rows(
    rows: Sequence[PoseRow], sub_map: int, frame: WorldFrame, places: Mapping[int, Sim3]
) -> list[PoseRow]:
    """The table with what the sub-map's ``frame`` says of its ``places``: T_nc by time, ns."""
    members = [row for row in rows if row.sub_map == sub_map]
    poses = [places[round(1e9 * row.t_s)] for row in members]
    path = np.array([T_nc.t for T_nc in poses]).reshape(-1, 3)
    speeds = speeds_of(np.array([row.t_s for row in members]), path)
    found = {row.index: row for row in rows}
    for row, T_nc, speed in zip(members, poses, speeds, strict=True):
        x, y, z = T_nc.t.tolist()
        heading, roll, pitch = attitude_of(frame, T_nc)
        found[row.index] = replace(
            row, x=x, y=y, z=z, unit=frame.unit,
            heading_deg=heading, roll_deg=roll, pitch_deg=pitch,
            speed_m_s=speed if frame.metric else None,
            sigma_position_m=position_sigma(frame, T_nc.t),
            sigma_heading_deg=heading_sigma_deg(frame),
        )  # fmt: skip
    return list(found.values())


def _medium(data: dict[str, Any], frame: WorldFrame, times: float) -> dict[str, Any]:
    """medium.json with rates per unit of ``frame`` and ranges in it."""
    data |= {"scale_source": frame.scale_source, "unit": frame.unit}
    if not data["active"] or times == 1.0:
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
    if times == 1.0:
        return
    for path in sorted(folder.glob("*_range.npz")):
        z = read_arrays_of(path, folders=1, most_bytes=MOST_RANGE_BYTES)["z"]
        with atomic_write(path) as stream:
            np.savez_compressed(stream, z=(times * z.astype(np.float64)).astype(np.float32))


# --------------------------------------------------------------------------------------------------
# What was made of the dive in its former frame, and has to be made anew.

Progress = Callable[[str, int, int], None]
"""Called with what is done, how much of it, and how much there is."""


def measure_anew(dive: Path, progress: Progress | None) -> None:
    """Write the reef numbers of a dive in its new frame; none where it had none, or where it cannot
    be measured."""
    if not (dive / JSON).is_file():
        return
    from aquaflow.survey.measure.finished_dive import numbers_of_dive

    # Those in another frame would contradict the rest of the folder.
    for name in (JSON, CSV):
        (dive / name).unlink(missing_ok=True)
    try:
        with tempfile.TemporaryDirectory() as work:
            write_reef_numbers(dive, numbers_of_dive(Dive(dive), Path(work), progress=progress))
    except InputError:
        return  # aquaflow measure says why
