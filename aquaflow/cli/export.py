"""The commands that make files of a dive: ``export``, report and video. Thin, as all of cli/."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import typer

from aquaflow.base.errors import ArgumentError, InputError
from aquaflow.base.errors.regular_file import refuse_linked_folders
from aquaflow.cli.console import GroupWithDefault, Json, WhiteBalanceOption, progress_bars

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
REPORT = "report.pdf"
"""In the dive's folder, where no other place is given."""


Progress = Callable[[int, int], None]
Bars = Callable[[str, int, int], None]


def export_group() -> typer.Typer:
    """The group ``export`` with its commands."""
    group = typer.Typer(cls=GroupWithDefault)
    group.command("export")(export)
    group.command()(report)
    group.command()(video)
    return group


def export(
    dive: Annotated[Path, typer.Argument(help="Dive folder.")],
    format: Annotated[
        str | None,
        typer.Option(
            help="One or more, with commas between. "
            "restored: frames without their water. laz, e57: the map as points. "
            "colmap, nerfstudio: pictures, poses and points. spz: the map, compressed. "
            "ply, obj, glb: the surface as triangles. "
            "ortho: the ground from straight above. dem: its heights. "
            "geotags, odm: where each picture was taken, a table for Metashape or OpenDroneMap. "
            "mcap: all of it for Foxglove and ROS 2."
        ),
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="All formats that the dive has.")] = False,
    recording: Annotated[
        Path | None,
        typer.Option(
            help="What was mapped, if it no longer lies where it was; without it, "
            "pictures without water are drawn."
        ),
    ] = None,
    restored: Annotated[
        bool, typer.Option("--restored", help="Pictures and points without water.")
    ] = False,
    water: Annotated[
        bool, typer.Option("--water", help="Colours as seen through the water, not without it.")
    ] = False,
    resolution: Annotated[
        float | None,
        typer.Option(
            help="m a pixel or voxel (map units without metres); without it, as in the pictures."
        ),
    ] = None,
    white_balance: WhiteBalanceOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder to write to, or a file with the format's ending; else the dive's folder."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Write a dive for other programs: pictures without water, points, posed pictures, maps."""
    formats = _asked_formats(format, every)
    given = {
        "--recording": recording is not None, "--restored": restored, "--water": water,
        "--resolution": resolution is not None, "--white-balance": white_balance is not None,
    }  # fmt: skip
    _refuse_others(formats, given)
    if resolution is not None and not (math.isfinite(resolution) and resolution > 0.0):
        raise ArgumentError(
            f"--resolution {resolution:g} is no size of a pixel; give a positive one"
        )
    from aquaflow.dive.dive import FRAMES, MAP, TRAJECTORY, Dive

    read = Dive(dive)
    read.require(*((FRAMES, TRAJECTORY) if set(formats) <= TABLES else (MAP,)))
    if every:
        formats = all_formats(read)
    if white_balance is not None:
        _choose_white(read, white_balance, water or (not restored and set(formats) <= POSED))
    targets = _targets(dive, formats, out)
    with progress_bars(quiet=as_json) as bars:
        job = _Job(read, recording or read.recording, restored, water, resolution, bars)
        done = _write_each(job, targets)
    if as_json:
        facts = {each.value: {"out": str(targets[each]), **of} for each, (_, of) in done.items()}
        typer.echo(json.dumps(facts if len(formats) > 1 else facts[formats[0].value]))
    else:
        typer.echo("\n".join(said for said, _ in done.values()))


def all_formats(dive: Dive) -> list[ExportFormat]:
    """What ``--all`` writes: places of pictures only where the dive has some."""
    from aquaflow.dive.placement import grid_of

    placed = grid_of(dive.frame) is not None
    return [each for each in ExportFormat if placed or each not in TABLES]


def _asked_formats(format: str | None, every: bool) -> list[ExportFormat]:
    """Raises typer.BadParameter where none, or one that does not exist, is asked for."""
    if every == (format is not None):
        raise typer.BadParameter("give --format, or --all")
    if format is None:
        return list(ExportFormat)
    words = [word.strip() for word in format.split(",")]
    for word in words:
        if word not in set(ExportFormat):
            known = ", ".join(ExportFormat)
            raise typer.BadParameter(f"{word!r} is no --format; there are {known}")
    return [each for each in ExportFormat if each.value in words]


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
            return {first: _make_parents(out)}
        own = (
            f"a file ending in {ENDINGS[first]}, or "
            if len(formats) == 1 and first in ENDINGS
            else ""
        )
        raise ArgumentError(f"--out {out} is no name for {', '.join(formats)}; give {own}a folder")
    if len(formats) == 1 and first in FOLDERS:
        return {first: _make_parents(out)}
    return {each: _make_parents(out / NAMES[each]) for each in formats}


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


def _write_each(job: _Job, targets: Mapping[ExportFormat, Path]) -> Made:
    """Write the formats; one that fails costs itself.

    Raises:
        InputError: some failed, after all others are written.
    """
    made: Made = {}
    failed: dict[str, list[str]] = {}
    single = [[each] for each in targets if each not in {**RASTERS, **MESHES}]
    grouped = [[each for each in targets if each in kind] for kind in (RASTERS, MESHES)]
    for group in filter(None, [*single, *grouped]):
        together = {each: targets[each] for each in group}
        try:
            made |= _write(job, together)
        except InputError as error:
            if len(targets) == 1:
                raise
            failed.setdefault(str(error), []).extend(together)
    if failed:
        for said, _ in made.values():
            typer.echo(said, err=True)
        raise InputError("; ".join(f"{', '.join(names)}: {why}" for why, names in failed.items()))
    return made


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


def report(
    dive: Annotated[Path, typer.Argument(help="Dive folder.")],
    pdf: Annotated[Path | None, typer.Option(help="File; else report.pdf in the dive.")] = None,
    as_json: Json = False,
) -> None:
    """Write the report of a finished dive as one PDF, to print or to send."""
    if pdf is not None and pdf.suffix.lower() != ".pdf":
        raise ArgumentError(f"{pdf} does not end in .pdf; give the report a file of its own")
    from aquaflow.dive.dive import FRAMES, METRICS, Dive
    from aquaflow.survey.report.pdf import write_pdf
    from aquaflow.survey.report.report_of import report_of

    of = Dive(dive)
    of.require(FRAMES, METRICS)
    out = _make_parents(pdf) if pdf else dive / REPORT
    pages = write_pdf(out, report_of(of))
    if as_json:
        typer.echo(json.dumps({"pdf": str(out), "pages": pages}))
        return
    typer.echo(f"Wrote {pages} pages to {out}.")


def _make_parents(path: Path) -> Path:
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


def _choose_white(dive: Dive, white_balance: str, shows_water: bool) -> None:
    if shows_water:
        raise ArgumentError(
            "a white balance is of colours without water, and these are as the camera saw them; "
            "leave --white-balance out"
        )
    from aquaflow.dive.white_balance import show_in

    show_in(dive, white_balance)


def _refuse_others(formats: Sequence[ExportFormat], given: dict[str, bool]) -> None:
    known = set().union(*(OPTIONS[each] for each in formats))
    unknown = [name for name, is_given in given.items() if is_given and name not in known]
    if unknown:
        raise ArgumentError(f"--format {','.join(formats)} knows no {unknown[0]}; leave it out")


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
            "origin": mesh.origin, "colours": mesh.seen,
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
    return said, {
        "layout": str(wrote.layout), "messages": wrote.messages, "poses": wrote.poses,
        "pictures": wrote.pictures, "unit": where.unit, "axes": where.axes, "times": wrote.times,
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


# --------------------------------------------------------------------------------------------------
# The command that makes a video of a dive: ``export video``. Thin, like all of cli/.


class VideoKind(str, Enum):
    """What a video can show."""

    side_by_side = "side-by-side"
    fly_through = "fly-through"
    restored = "restored"


VIDEO_OPTIONS = {
    VideoKind.side_by_side: {"--recording", "--white-balance"},
    VideoKind.fly_through: {"--water", "--seconds", "--width", "--white-balance"},
    VideoKind.restored: {"--recording", "--width", "--white-balance"},
}
"""Which options a kind knows, besides --out and --json."""
FLIGHT_S = 20.0
"""Length of a flight that nobody asked to be longer."""
LONGEST_FLIGHT_S = 3600.0
WIDTHS = (64, 8192)
"""px; as of the pictures that are mapped."""


def video(
    dive: Annotated[Path, typer.Argument(help="Dive folder.")],
    out: Annotated[Path, typer.Option(help="File to write, .mp4.")],
    kind: Annotated[
        VideoKind,
        typer.Option(
            help="side-by-side: camera and without water, with depth, heading, time and speed. "
            "fly-through: the map along a smooth path. restored: every frame of the recording "
            "without its water."
        ),
    ] = VideoKind.side_by_side,
    recording: Annotated[Path | None, typer.Option(help="What was mapped.")] = None,
    water: Annotated[
        bool, typer.Option("--water", help="Fly through the water, not without it.")
    ] = False,
    seconds: Annotated[float | None, typer.Option(help="Length of a flight; 20.")] = None,
    width: Annotated[int | None, typer.Option(help="Pixels; else as mapped.")] = None,
    white_balance: WhiteBalanceOption = None,
    as_json: Json = False,
) -> None:
    """Make a video of a dive, for browsers: a flight through the map, or its pictures restored."""
    given = {
        "--recording": recording is not None, "--water": water, "--seconds": seconds is not None,
        "--width": width is not None, "--white-balance": white_balance is not None,
    }  # fmt: skip
    _refuse(kind, given, seconds, width)
    from aquaflow.dive.dive import MAP, Dive

    read = Dive(dive)
    read.require(MAP)
    if white_balance is not None:
        _choose_white(read, white_balance, water)
    _make_parents(out)
    with progress_bars(quiet=as_json) as bars:

        def progress(done: int, total: int) -> None:
            bars("video", done, total)

        facts: dict[str, Any]
        if kind is VideoKind.fly_through:
            from aquaflow.survey.video.fly_through import fly_through

            flight_s = FLIGHT_S if seconds is None else seconds
            count = fly_through(read, out, flight_s, water, width, progress)
            said, facts = f"Wrote a flight of {count} pictures to {out}.", {"frames": count}
        elif kind is VideoKind.side_by_side:
            from aquaflow.survey.video.every_frame import side_by_side

            count = side_by_side(read, out, recording or read.recording, progress)
            said, facts = f"Wrote {count} frames side by side to {out}.", {"frames": count}
        else:
            from aquaflow.survey.video.every_frame import restore_every_frame

            source = recording or read.recording
            if source is None:
                raise InputError("--kind restored needs --recording: a dive keeps no pictures")
            wrote = restore_every_frame(read, out, source, width, progress)
            said = f"Wrote {wrote.frames} frames to {out}, {wrote.restored} of them restored."
            facts = {"frames": wrote.frames, "restored": wrote.restored}
    typer.echo(json.dumps({"out": str(out), **facts}) if as_json else said)


def _refuse(
    kind: VideoKind, given: dict[str, bool], seconds: float | None, width: int | None
) -> None:
    unknown = [
        name for name, is_given in given.items() if is_given and name not in VIDEO_OPTIONS[kind]
    ]
    if unknown:
        raise ArgumentError(f"--kind {kind.value} knows no {unknown[0]}; leave it out")
    if seconds is not None and not (math.isfinite(seconds) and 0.0 < seconds <= LONGEST_FLIGHT_S):
        raise ArgumentError(f"--seconds {seconds:g} is no length; give 0 to {LONGEST_FLIGHT_S:.0f}")
    if width is not None and not WIDTHS[0] <= width <= WIDTHS[1]:
        raise ArgumentError(
            f"--width {width} is out of range; give {WIDTHS[0]} to {WIDTHS[1]} pixels"
        )
