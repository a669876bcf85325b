"""The commands for several dives of one place: ``site add``, ``merge``, ``map``, ``list``,
``check``."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from aquaflow.cli.console import Json, progress_bars

if TYPE_CHECKING:
    from aquaflow.survey.change.site_refinement import RefinedMap
    from aquaflow.survey.site.merged_file import MergedSite
    from aquaflow.survey.site.merging import LookUp, Progress

Site = Annotated[Path, typer.Argument(help="Site folder.")]

app = typer.Typer()


@app.command()
def add(
    site: Site,
    dives: Annotated[list[Path], typer.Argument(help="Finished dive folders.")],
    as_json: Json = False,
) -> None:
    """Add finished dives to a site, which is made if it is not there."""
    from aquaflow.survey.site.merging import add_to_site

    new = add_to_site(site, dives)
    if as_json:
        typer.echo(json.dumps({"added": [dive.name for dive in new]}))
        return
    names = ", ".join(dive.name for dive in new)
    typer.echo(f"Added: {names}." if new else "All of them are in the site already, unchanged.")


@app.command()
def merge(
    site: Site,
    jobs: Annotated[int | None, typer.Option(help="Dives looked up at once; else one.")] = None,
    cluster: Annotated[
        str | None,
        typer.Option(help="Look them up on a Ray cluster: auto | host:6379 | ray://host:10001"),
    ] = None,
    as_json: Json = False,
) -> None:
    """Recognise the dives of a site in each other, and optimise them together."""
    from aquaflow.survey.site.merging import merge as merged_site

    with progress_bars(quiet=as_json) as progress:
        if jobs is not None or cluster is not None:
            _look_up_elsewhere(site, jobs, cluster, progress)
        merged = merged_site(site, progress)
    if as_json:
        typer.echo(json.dumps(_numbers(merged)))
        return
    for line in _in_words(merged):
        typer.echo(line)
    typer.echo(f"Written to {site}: merged.json, merged.npy, paths/.")


LOOK_UP_MB = 300
"""What a process takes that looks a dive up, 1e6 bytes: 170 of it libraries, 77 the keypoints that
it holds (links.KEPT)."""
KEYFRAMES_AT_ONCE = 60
"""That a process looks up at least, so that its start, 0.6 s of CPU, is a tenth of it: a keyframe
takes 0.03 to 0.1 s (notes/2026-11-sites.md#distributed)."""


def _look_up_elsewhere(
    site: Path, jobs: int | None, cluster: str | None, progress: Progress
) -> None:
    """Look the dives up in other processes; what fails there is left to the merge."""
    from aquaflow.config.stage import COMMAND_LINE, validate
    from aquaflow.lab.batch.batch import run_calls
    from aquaflow.lab.batch.job import BatchConfig, CallJob
    from aquaflow.survey.site.merging import look_ups

    asked = validate(BatchConfig, {"jobs": jobs, "cluster": cluster}, COMMAND_LINE)
    calls = [
        CallJob(
            _name_of(part), "aquaflow.survey.site.merging:look_up",
            {"site": str(site.resolve()), "wanted": [(each.dive, each.among) for each in part]},
            sum(each.keyframes for each in part), LOOK_UP_MB,
        )
        for part in _parts(look_ups(site))
    ]  # fmt: skip
    failed = run_calls(calls, site, "look-ups", asked, progress) if calls else {}
    for name, why in failed.items():
        typer.echo(f"Looking up {name} failed elsewhere and is done here: {why}.", err=True)


def _parts(wanted: list[LookUp]) -> Iterator[list[LookUp]]:
    """As many look-ups together as are worth a process, in their order."""
    part: list[LookUp] = []
    for each in wanted:
        part.append(each)
        if sum(one.keyframes for one in part) >= KEYFRAMES_AT_ONCE:
            yield part
            part = []
    if part:
        yield part


def _name_of(part: list[LookUp]) -> str:
    first, more = part[0].name, len(part) - 1
    return f"{first} and {more} more" if more else first


@app.command("map")
def write_map(
    site: Site,
    component: Annotated[
        int | None, typer.Option(help="Its number in `site list`; else the largest.")
    ] = None,
    refine_steps: Annotated[
        int,
        typer.Option(min=0, help="Optimise it so many steps on the pictures of all dives."),
    ] = 0,
    refine_seconds: Annotated[
        float | None, typer.Option(min=0.0, help="Longest that this may take, s.")
    ] = None,
    as_json: Json = False,
) -> None:
    """One map of the merged dives: of each place the dive that shows it last, or more finely."""
    from aquaflow.survey.change.site_map import make_site_map

    refined: RefinedMap | None = None
    with progress_bars(quiet=as_json) as progress, tempfile.TemporaryDirectory() as work:
        if refine_steps:
            from aquaflow.survey.change.site_refinement import make_refined_map

            made, refined = make_refined_map(
                site, component, refine_steps, refine_seconds, Path(work), progress
            )
        else:
            made = make_site_map(site, component, Path(work), progress)
    if as_json:
        dives = [asdict(part) for part in made.parts]
        said = {"map": str(made.ply), "dives": dives, "left_out": made.left_out}
        if refined is not None:
            in_pictures = [asdict(dive) for dive in refined.dives]
            said["refined"] = {"steps": refined.steps, "dives": in_pictures}
        typer.echo(json.dumps(said))
        return
    for part in made.parts:
        typer.echo(
            f"{part.name}: {part.gaussians} Gaussians stay; {part.gone} are gone since, "
            f"{part.replaced} are of places that another dive shows."
        )
    for name, reason in made.left_out.items():
        typer.echo(f"Left out: {name}: {reason}.")
    for line in [] if refined is None else _refinement_in_words(refined):
        typer.echo(line)
    typer.echo(f"Wrote {made.ply}; `aquaflow view {site}` shows it.")


@app.command("list")
def list_dives(site: Site, as_json: Json = False) -> None:
    """The dives of a site, and how they lie to each other since the last merge."""
    from aquaflow.survey.site.manifest import read_site
    from aquaflow.survey.site.merged_file import read_merged

    dives, merged = read_site(site), read_merged(site)
    rows: list[dict[str, Any]] = [
        {
            "name": dive.name,
            "folder": str(dive.folder(site)),
            "merged": merged is not None and merged.fingerprints.get(dive.name) == dive.fingerprint,
            "components": []
            if merged is None
            else sorted({each.component for each in merged.of_dive(dive.name)}),
        }
        for dive in dives
    ]
    if as_json:
        said = {"dives": rows, "merged": None if merged is None else _numbers(merged)}
        typer.echo(json.dumps(said))
        return
    for row in rows:
        where = ", ".join(map(str, row["components"])) if row["merged"] else "not merged yet"
        typer.echo(f"{row['name']}: component {where}; {row['folder']}")
    for line in [] if merged is None else _in_words(merged):
        typer.echo(line)


@app.command()
def check(site: Site, as_json: Json = False) -> None:
    """Whether the dives are as they were added and merged; exit code 1 if not."""
    from aquaflow.survey.site.checking import check_site

    found = check_site(site)
    if as_json:
        typer.echo(json.dumps({"good": not found, "findings": found}))
    else:
        for finding in found or ["All dives are as they were added and merged."]:
            typer.echo(finding)
    if found:
        raise typer.Exit(1)


def _refinement_in_words(refined: RefinedMap) -> list[str]:
    lines = [f"Refined in {refined.steps} steps."]
    for dive in refined.dives:
        said = f"{dive.views} views"
        if dive.reason:
            said = f"nothing was learned from its pictures: {dive.reason}"
        if dive.psnr_before is not None and dive.psnr_after is not None:
            said += (
                f"; {dive.held_out} held-out views {dive.psnr_before:.2f} dB before, "
                f"{dive.psnr_after:.2f} dB after"
            )
        lines.append(f"{dive.name}: {said}.")
    return lines


def _numbers(merged: MergedSite) -> dict[str, Any]:
    used = sum(link["verdict"] == "used" for link in merged.links)
    return {
        "components": list(merged.components), "links": len(merged.links), "links_used": used,
        "left_out": dict(merged.left_out),
        "sub_maps": [
            {
                "dive": each.dive, "sub_map": each.number, "component": each.component,
                "keyframes": each.keyframes, "bent": each.bent,
            }
            for each in merged.sub_maps
        ],
    }  # fmt: skip


def _in_words(merged: MergedSite) -> list[str]:
    used = sum(link["verdict"] == "used" for link in merged.links)
    lines = [f"{used} of {len(merged.links)} links between dives agree."]
    for number, component in enumerate(merged.components):
        dives, unit = ", ".join(component["dives"]), component["unit"]
        lines.append(
            f"Component {number}: {dives}; {component['keyframes']} keyframes, lengths in {unit}."
        )
    if len(merged.components) > 1:
        lines.append(
            "Components never met: how they lie to each other is not known from the pictures."
        )
    lines += [f"Left out: {name}: {reason}." for name, reason in merged.left_out.items()]
    return lines
