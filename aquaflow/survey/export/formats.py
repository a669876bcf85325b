"""A dive in the formats of other programs: which there are, where each goes, what shares its work.

``aquaflow export`` and :func:`aquaflow.export` both call :func:`export_dive`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from aquaflow.base.errors import ArgumentError, InputError
from aquaflow.base.errors.regular_file import refuse_linked_folders

if TYPE_CHECKING:
    from aquaflow.dive.dive import Dive
    from aquaflow.dive.point_cloud import PointCloud, PosedView


class ExportFormat(StrEnum):
    """What a dive can be written as."""

    restored = "restored"
    laz = "laz"
    e57 = "e57"
    colmap = "colmap"
    nerfstudio = "nerfstudio"
    spz = "spz"
    ply = "ply"
    obj = "obj"
    glb = "glb"
    ortho = "ortho"
    dem = "dem"
    geotags = "geotags"
    odm = "odm"
    mcap = "mcap"


NAMES = {
    ExportFormat.restored: "restored",
    ExportFormat.laz: "points.laz",
    ExportFormat.e57: "points.e57",
    ExportFormat.colmap: "colmap",
    ExportFormat.nerfstudio: "nerfstudio",
    ExportFormat.spz: "map.spz",
    ExportFormat.ply: "mesh.ply",
    ExportFormat.obj: "mesh.obj",
    ExportFormat.glb: "mesh.glb",
    ExportFormat.ortho: "ortho",
    ExportFormat.dem: "dem",
    ExportFormat.geotags: "geotags.csv",
    ExportFormat.odm: "geo.txt",
    ExportFormat.mcap: "dive.mcap",
}
"""Of what is written, in the dive's folder or in ``--out``."""
ENDINGS = {
    **{format: Path(name).suffix for format, name in NAMES.items() if Path(name).suffix},
    **{ExportFormat.ortho: ".tif", ExportFormat.dem: ".tif"},
}
"""Of formats that ``--out`` may name a file of."""
OPTIONS = {
    ExportFormat.restored: {"--recording", "--white-balance"},
    ExportFormat.laz: {"--water", "--white-balance"},
    ExportFormat.e57: {"--water", "--white-balance"},
    ExportFormat.colmap: {"--recording", "--restored", "--white-balance"},
    ExportFormat.nerfstudio: {"--recording", "--restored", "--white-balance"},
    ExportFormat.spz: {"--water", "--white-balance"},
    ExportFormat.ply: {"--water", "--resolution", "--white-balance"},
    ExportFormat.obj: {"--water", "--resolution", "--white-balance"},
    ExportFormat.glb: {"--water", "--resolution", "--white-balance"},
    ExportFormat.ortho: {"--water", "--resolution", "--white-balance"},
    ExportFormat.dem: {"--resolution"},
    ExportFormat.geotags: set(),
    ExportFormat.odm: set(),
    ExportFormat.mcap: {"--recording", "--white-balance"},
}
"""Which options a format knows, besides --out and --json."""
RASTERS: dict[ExportFormat, Literal["ortho", "dem"]] = {
    ExportFormat.ortho: "ortho",
    ExportFormat.dem: "dem",
}
"""Formats that are drawn from straight above, in one go."""
MESHES: dict[ExportFormat, Literal["ply", "obj", "glb"]] = {
    ExportFormat.ply: "ply",
    ExportFormat.obj: "obj",
    ExportFormat.glb: "glb",
}
"""Formats that are triangles, of one surface."""
FOLDERS = {ExportFormat.restored, *RASTERS, ExportFormat.colmap, ExportFormat.nerfstudio}
"""Formats that fill a folder."""
TABLES = {ExportFormat.geotags, ExportFormat.odm}
"""Formats of the path alone."""
POSED = {ExportFormat.colmap, ExportFormat.nerfstudio}
"""Formats of pictures that are as the camera saw them unless ``--restored`` says otherwise."""
Progress = Callable[[int, int], None]
Bars = Callable[[str, int, int], None]
"""Called with a stage, the steps done and the number of steps."""


@dataclass(frozen=True)
class ExportRequest:
    """What is asked for, of all formats; ``aquaflow export --help`` says what each means."""

    recording: Path | None = None
    restored: bool = False
    water: bool = False
    resolution: float | None = None
    white_balance: str | None = None

    def given(self) -> list[str]:
        """The options that are not left to their defaults, as the command line has them."""
        is_given = {
            "--recording": self.recording is not None,
            "--restored": self.restored,
            "--water": self.water,
            "--resolution": self.resolution is not None,
            "--white-balance": self.white_balance is not None,
        }
        return [name for name, given in is_given.items() if given]


@dataclass(frozen=True)
class Exported:
    """One format that was written."""

    format: ExportFormat
    said: str
    """For a person."""
    facts: dict[str, Any]
    """The same by name, as ``--json`` has it."""


def export_dive(
    dive: Dive,
    formats: Sequence[ExportFormat] | None,
    out: Path | None,
    request: ExportRequest,
    bars: Bars,
    done: Callable[[Exported], None],
) -> None:
    """Write the largest sub-map of a finished ``dive``; what formats share is drawn once.

    Args:
        formats: None: all that the dive has.
        out: a folder, or a file with the ending of a single format; None: the dive's folder.
        done: called after each that was written; one that fails costs itself.

    Raises:
        ArgumentError: a format does not know an option, or ``out`` is a file of another.
        InputError: the dive is not finished, has no map, or some formats failed, after all others
            are written.
        ConfigError: the dive's settings cannot be read.
    """
    from aquaflow.dive.dive import FRAMES, MAP, TRAJECTORY

    _refuse_others(formats or list(ExportFormat), request.given())
    if request.resolution is not None and not (
        math.isfinite(request.resolution) and request.resolution > 0.0
    ):
        raise ArgumentError(
            f"--resolution {request.resolution:g} is no size of a pixel; give a positive one"
        )
    tables_only = formats is not None and set(formats) <= TABLES
    dive.require(*((FRAMES, TRAJECTORY) if tables_only else (MAP,)))
    chosen = all_formats(dive) if formats is None else formats
    if request.white_balance is not None:
        sees_water = request.water or (not request.restored and set(chosen) <= POSED)
        choose_white(dive, request.white_balance, sees_water)
    targets = _targets(dive.path, chosen, out)
    recording = request.recording or dive.recording
    job = _Job(dive, recording, request.restored, request.water, request.resolution, bars)
    _write_each(job, targets, done)


def read_formats(words: str | Sequence[str]) -> list[ExportFormat]:
    """The formats of a text with commas between, or of several texts, in their usual order.

    Raises:
        ArgumentError: one does not exist.
    """
    names = [name.strip() for name in (words.split(",") if isinstance(words, str) else words)]
    for name in names:
        if name not in set(ExportFormat):
            known = ", ".join(ExportFormat)
            raise ArgumentError(f"{name!r} is no --format; there are {known}")
    return [each for each in ExportFormat if each.value in names]


def all_formats(dive: Dive) -> list[ExportFormat]:
    """What ``--all`` writes: places of pictures only where the dive has some."""
    from aquaflow.dive.placement import grid_of

    placed = grid_of(dive.frame) is not None
    return [each for each in ExportFormat if placed or each not in TABLES]


def _targets(
    dive: Path, formats: Sequence[ExportFormat], out: Path | None
) -> dict[ExportFormat, Path]:
    """Where each format is written to: its usual name in the dive or in ``out``, unless a single
    one is named, or fills a folder.

    Raises:
        ArgumentError: ``out`` is a file of another format.
        InputError: no folder can be there.
    """
    if out is None:
        return {each: _own_target(dive / NAMES[each]) for each in formats}
    ending, first = out.suffix.lower(), formats[0]
    if ending in ENDINGS.values():
        if len(formats) == 1 and ENDINGS.get(first) == ending:
            return {first: make_parents(out)}
        own = (
            f"a file ending in {ENDINGS[first]}, or "
            if len(formats) == 1 and first in ENDINGS
            else ""
        )
        raise ArgumentError(f"--out {out} is no name for {', '.join(formats)}; give {own}a folder")
    if len(formats) == 1 and first in FOLDERS:
        return {first: make_parents(out)}
    return {each: make_parents(out / NAMES[each]) for each in formats}


def make_parents(path: Path) -> Path:
    """``path``, with the folders above it made: a file or a folder may be wanted anywhere."""
    from aquaflow.base.storage.atomic import explain_refusal

    with explain_refusal(path):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError) as error:
            raise OSError(error.errno, f"{path.parent} is no folder") from error
    return path


def _own_target(path: Path) -> Path:
    """``path``, which lies in a dive that others may have made, unless it leads out of it."""
    try:
        refuse_linked_folders(path)
    except OSError as error:
        raise InputError(
            f"cannot write to {error.filename}: {error.strerror}; remove it, or give --out"
        ) from error
    return path


def choose_white(dive: Dive, white_balance: str, shows_water: bool) -> None:
    """Show ``dive``, as it is in memory, in another white balance.

    Raises:
        ArgumentError: there is no such, or what is asked for ``shows_water``.
        InputError: the dive cannot be shown in it.
    """
    if shows_water:
        raise ArgumentError(
            "a white balance is of colours without water, and these are as the camera saw them; "
            "leave --white-balance out"
        )
    from aquaflow.dive.white_balance import show_in

    show_in(dive, white_balance)


def _refuse_others(formats: Sequence[ExportFormat], given: Sequence[str]) -> None:
    known = set().union(*(OPTIONS[each] for each in formats))
    unknown = [name for name in given if name not in known]
    if unknown:
        raise ArgumentError(f"--format {','.join(formats)} knows no {unknown[0]}; leave it out")


@dataclass(frozen=True)
class _Job:
    """What is asked for, of all formats."""

    dive: Dive
    recording: Path | None
    restored: bool
    water: bool
    resolution: float | None
    bars: Bars

    def progress(self, format: ExportFormat) -> Progress:
        """A function (done, total) for the bar of a format."""
        return lambda done, total: self.bars(format.value, done, total)


Made: TypeAlias = dict[ExportFormat, tuple[str, dict[str, Any]]]
"""Of each format: what is said, and the same as facts."""


def _write_each(
    job: _Job, targets: Mapping[ExportFormat, Path], done: Callable[[Exported], None]
) -> None:
    """Raises InputError where some failed, after all others are written."""
    failed: dict[str, list[str]] = {}
    single = [[each] for each in targets if each not in {**RASTERS, **MESHES}]
    grouped = [[each for each in targets if each in kind] for kind in (RASTERS, MESHES)]
    for group in filter(None, [*single, *grouped]):
        together = {each: targets[each] for each in group}
        try:
            made = _write(job, together)
        except InputError as error:
            if len(targets) == 1:
                raise
            failed.setdefault(str(error), []).extend(together)
            continue
        for each, (said, facts) in made.items():
            done(Exported(each, said, {"out": str(targets[each]), **facts}))
    if failed:
        raise InputError("; ".join(f"{', '.join(names)}: {why}" for why, names in failed.items()))


def _write(job: _Job, together: Mapping[ExportFormat, Path]) -> Made:
    """Write formats that are made in one go."""
    format, path = next(iter(together.items()))
    if format in RASTERS:
        return _survey(job, together)
    if format in MESHES:
        return _mesh(job, together)
    write = {
        ExportFormat.restored: _restore, ExportFormat.spz: _compress, ExportFormat.mcap: _messages,
        ExportFormat.laz: _points, ExportFormat.e57: _points,
        ExportFormat.geotags: _geotags, ExportFormat.odm: _geotags,
    }.get(format, _posed_pictures)  # fmt: skip
    return {format: write(job, path, format)}


def _restore(job: _Job, path: Path, format: ExportFormat) -> tuple[str, dict[str, Any]]:
    from aquaflow.dive.restored import export_restored

    count = export_restored(job.dive, path, job.recording, job.progress(format))
    said = f"Wrote {count} restored frames to {path}{_source(job)}.\n{_geotagged(job)}"
    return said, {"frames": count, "geotagged": job.dive.frame.georeferenced}


def _geotagged(job: _Job) -> str:
    from aquaflow.survey.export.geotags import missing_place

    frame = job.dive.frame
    if frame.georeferenced:
        return "Each says in EXIF where it was taken."
    return f"None says in EXIF where it was taken: the dive has no place; {missing_place(frame)}."


def _source(job: _Job) -> str:
    """Which pictures were taken, for the end of a sentence."""
    return ", drawn from the map" if job.recording is None else f", from {job.recording}"


def _points(job: _Job, path: Path, format: ExportFormat) -> tuple[str, dict[str, Any]]:
    from aquaflow.dive.point_cloud import read_point_cloud
    from aquaflow.survey.export.point_clouds import write_e57, write_laz

    cloud = read_point_cloud(job.dive, job.water)
    write = write_laz if format is ExportFormat.laz else write_e57
    write(path, cloud, job.progress(format))
    where = cloud.placement
    return f"Wrote {len(cloud)} points to {path}: {where.in_words()}.", {
        "points": len(cloud),
        "unit": where.unit,
        "epsg": where.epsg,
        "axes": where.in_words(),
    }


def _compress(job: _Job, path: Path, format: ExportFormat) -> tuple[str, dict[str, Any]]:
    from aquaflow.survey.export.spz import export_spz

    count, where = export_spz(job.dive, path, job.water)
    axes = where.in_words(y_up=True)
    facts = {"gaussians": count, "unit": where.unit, "axes": axes}
    return f"Wrote {count} Gaussians to {path}: {axes}.", facts


def _mesh(job: _Job, together: Mapping[ExportFormat, Path]) -> Made:
    from aquaflow.survey.export.mesh.export_mesh import export_mesh

    targets = {MESHES[each]: path for each, path in together.items()}
    mesh = export_mesh(job.dive, targets, job.resolution, job.water, job.bars)
    made: Made = {}
    unit = mesh.where.unit
    for each in together:
        files = [str(file) for file in mesh.files[MESHES[each]]]
        axes = mesh.where.in_words(y_up=each is ExportFormat.glb)
        said = (
            f"Wrote {' and '.join(files)}: {mesh.triangles} triangles of {mesh.voxel:g} {unit}, "
            f"{mesh.seen}.\nCoordinates: {axes}"
        )
        said += f", less {mesh.origin[0]:g}, {mesh.origin[1]:g}." if mesh.where.epsg else "."
        made[each] = said, {
            "files": files,
            "vertices": mesh.vertices, "triangles": mesh.triangles, "area": mesh.area,
            "resolution": mesh.voxel, "sigma": mesh.sigma,
            "texture": None if each is ExportFormat.ply else mesh.texture,
            "unit": unit, "epsg": mesh.where.epsg, "axes": axes,
            "origin": list(mesh.origin), "colours": mesh.seen,
        }  # fmt: skip
    return made


def _posed_pictures(job: _Job, path: Path, format: ExportFormat) -> tuple[str, dict[str, Any]]:
    from aquaflow.dive.placement import placement
    from aquaflow.dive.restored import export_posed_pictures
    from aquaflow.survey.export.posed_pictures import write_colmap, write_nerfstudio
    from aquaflow.survey.export.tracks import Tracks, tracks_in_folder

    tracks, colmap = Tracks.none(), format is ExportFormat.colmap

    def write(out: Path, views: Sequence[PosedView], cloud: PointCloud) -> None:
        nonlocal tracks
        if not colmap:
            write_nerfstudio(out, views, cloud)
            return
        if job.recording is not None:
            of_tracks = partial(job.bars, "colmap tracks")
            tracks = tracks_in_folder(out, views, cloud, of_tracks)
        write_colmap(out, views, cloud, tracks)

    count = export_posed_pictures(
        job.dive, path, write, job.recording, job.restored, job.progress(format)
    )
    where = placement(job.dive.frame)
    said = f"Wrote {count} pictures with their poses to {path}{_source(job)}: {where.axes}; "
    said += f"{where.unit}.\n{_geotagged(job)}"
    facts = {
        "frames": count, "unit": where.unit, "axes": where.axes,
        "geotagged": job.dive.frame.georeferenced,
    }  # fmt: skip
    if not colmap:
        return said, facts
    drawn = "pictures that are drawn measure nothing" if job.recording is None else None
    return f"{said}\n{tracks.in_words(drawn)}", facts | tracks.facts()


def _geotags(job: _Job, path: Path, format: ExportFormat) -> tuple[str, dict[str, Any]]:
    from aquaflow.survey.export.geotags import read_geotags, write_geo_txt, write_geotags

    tags = read_geotags(job.dive)
    write = write_geo_txt if format is ExportFormat.odm else write_geotags
    write(path, tags)
    said = (
        f"Wrote where {len(tags)} pictures were taken to {path}: EPSG:{tags.epsg}, heights above "
        f"{tags.height_zero}."
    )
    return said, {"frames": len(tags), "epsg": tags.epsg, "height_zero": tags.height_zero}


def _messages(job: _Job, path: Path, format: ExportFormat) -> tuple[str, dict[str, Any]]:
    from aquaflow.survey.export.mcap_export import export_mcap

    wrote = export_mcap(job.dive, path, job.recording, job.progress(format))
    where = wrote.where
    said = (
        f"Wrote {wrote.messages} messages to {path}, {wrote.poses} poses and {wrote.pictures} "
        f"pictures among them{_source(job)}; a layout for Foxglove to {wrote.layout}.\n"
        f"Frame map: {where.axes}; {where.unit}. Times: {wrote.times}."
    )
    if wrote.points_step > 1:
        said += f"\nOne of {wrote.points_step} points of the map; LAZ and E57 have all."
    return said, {
        "layout": str(wrote.layout), "messages": wrote.messages, "poses": wrote.poses,
        "pictures": wrote.pictures, "points_step": wrote.points_step, "unit": where.unit,
        "axes": where.axes, "times": wrote.times,
    }  # fmt: skip


def _survey(job: _Job, together: Mapping[ExportFormat, Path]) -> Made:
    from aquaflow.survey.export.ortho.survey import export_survey

    targets = {RASTERS[each]: path for each, path in together.items()}
    survey = export_survey(job.dive, targets, job.resolution, job.water, job.bars)
    made: Made = {}
    ground = survey.ground
    for each in together:
        files = [str(file) for file in survey.files[RASTERS[each]]]
        is_dem = each is ExportFormat.dem
        through = None if is_dem else survey.water_range
        said = [
            f"Wrote {' and '.join(files)}: {survey.width} x {survey.height} pixels of "
            f"{survey.resolution:g} {ground.unit}, {survey.covered:.0%} mapped.",
            f"Coordinates: {ground.axes}. Vertical: {ground.vertical}.",
        ]
        if is_dem:
            said.append(f"Heights are above {ground.height_zero}, {ground.unit}.")
        elif through is not None:
            said.append(f"Seen through {through:.3g} {ground.unit} of water.")
        made[each] = "\n".join(said), {
            "files": files,
            "width": survey.width, "height": survey.height, "resolution": survey.resolution,
            "covered": survey.covered, "unit": ground.unit, "epsg": ground.epsg,
            "axes": ground.axes, "vertical": ground.vertical, "height_zero": ground.height_zero,
            "water_range": through,
        }  # fmt: skip
    return made
