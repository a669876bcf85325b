"""The report's page: sections in the order in which a reader asks."""

from __future__ import annotations

import html
from pathlib import Path

from aquaflow.base.errors import printable_text
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.survey.report import measures, sections
from aquaflow.survey.report.data import ReportData


def write_report(path: Path, data: ReportData) -> None:
    """Write ``report.html`` atomically.

    Raises:
        InputError: the file cannot be written.
    """
    page = render_report(data)
    with atomic_write(path) as stream:
        stream.write(page.encode("utf-8"))


def render_report(data: ReportData) -> str:
    """The whole page; it loads nothing, and the same data give the same text."""
    body = [
        sections.warnings(data),
        sections.tiles(data.metrics),
        sections.path(data),
        sections.coverage(data),
        sections.profile(data.profile),
        measures.reef(data.reef),
        measures.measures(data.measures),
        measures.fixes(data),
        sections.examples(data),
        sections.medium(data),
        sections.water(data.medium),
        sections.timeline(data),
        sections.left_out(data.left_out),
        sections.notes(data),
        sections.camera(data.camera),
        sections.stages(data),
        sections.numbers(data.metrics),
    ]
    name = html.escape(data.name)
    version = html.escape(str(data.metrics.get("version", "")))
    written = f" on {html.escape(data.written)}" if data.written else ""
    return printable_text(
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{name}: AquaFlow dive report</title><style>{STYLE_SHEET}</style></head>"
        "<body><main>"
        f'<p class="brand">AquaFlow dive report</p><h1>{name}</h1>'
        f'<p class="lead">{_lead(data)}</p>\n'
        + "\n".join(part for part in body if part)
        + f"\n<footer>Written by AquaFlow {version}{written}.</footer></main></body></html>\n"
    )


def _lead(data: ReportData) -> str:
    """The dive in one or two sentences."""
    frames, tracked = data.metrics.get("frames"), data.metrics.get("tracked")
    if not frames or tracked is None:
        return "What one camera saw under water, as a path, a map and the water's own optics."
    said = f"{tracked:,} of {frames:,} frames have a pose."
    psnr, held_out = data.metrics.get("psnr"), data.metrics.get("heldout_frames")
    if psnr is not None and held_out:
        said += (
            f" On {held_out:,} frames that the mapper never saw, its pictures reach {psnr:.1f} dB."
        )
    return said


# --------------------------------------------------------------------------------------------------
# The report's style sheet: no web fonts, no images, light and dark.

STYLE_SHEET = """
:root {
  color-scheme: light dark;
  --paper: #f6f9fa; --card: #ffffff; --ink: #12262e; --soft: #56707a; --grid: #d5e0e4;
  --accent: #0b7f95;
  --keyframe: #0b7f95; --mapping: #4fb3c4; --common: #b5ccd2; --skipped: #e0d6b8;
  --lost: #e8505b; --dropped: #8d3b72;
}
@media (prefers-color-scheme: dark) {
  :root {
    --paper: #0d171b; --card: #142127; --ink: #e3eef1; --soft: #92aab3; --grid: #2b3d45;
    --accent: #4cc3d9;
    --keyframe: #4cc3d9; --mapping: #2a8a9c; --common: #3b545d; --skipped: #6b6346;
    --lost: #f0717b; --dropped: #b86a9e;
  }
}
* { box-sizing: border-box; }
body {
  margin: 0; padding: 2.5rem 1.25rem 4rem; background: var(--paper); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", sans-serif;
}
main { max-width: 62rem; margin: 0 auto; }
h1 { font-size: 2rem; line-height: 1.2; margin: 0 0 .4rem; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 0 0 .2rem; }
.brand { color: var(--accent); font-weight: 600; margin: 0 0 .6rem; }
.lead { font-size: 1.1rem; color: var(--soft); margin: 0 0 1.6rem; max-width: 46rem; }
section { background: var(--card); border: 1px solid var(--grid); border-radius: 12px;
  padding: 1.3rem 1.4rem 1.4rem; margin: 0 0 1.2rem; overflow-x: auto; }
section > p { color: var(--soft); margin: 0 0 1rem; max-width: 46rem; }
section > p.after { margin: .8rem 0 0; }
svg { width: 100%; height: auto; display: block; font-family: inherit; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(7.2rem, 1fr)); gap: .7rem;
  margin: 0 0 1.2rem; padding: 0; }
.tile { background: var(--card); border: 1px solid var(--grid); border-radius: 12px;
  padding: .8rem .85rem; }
.tile b { display: block; font-size: 1.3rem; font-weight: 650; line-height: 1.2;
  font-variant-numeric: tabular-nums; }
.tile span { color: var(--soft); font-size: .8rem; line-height: 1.35; display: block; }
.strip { width: 100%; height: 34px; border-radius: 6px; overflow: hidden; }
.key { display: flex; flex-wrap: wrap; gap: .3rem 1.2rem; margin: .7rem 0 0; padding: 0;
  list-style: none; font-size: .9rem; color: var(--soft); }
.key i { display: inline-block; width: .8em; height: .8em; border-radius: 3px;
  margin-right: .45em; vertical-align: -.05em; }
.views { display: grid; gap: .7rem; margin: 0 0 .4rem; }
@media (min-width: 34rem) {
  .of2, .of4 { grid-template-columns: 1fr 1fr; }
  .of3 { grid-template-columns: 1fr 1fr 1fr; }
  .value { white-space: nowrap; }
}
figure { margin: 0; }
figcaption { font-size: .84rem; color: var(--soft); margin-top: .25rem; }
.views img { width: 100%; border-radius: 8px; display: block; }
.overview img { display: block; max-width: 100%; max-height: 30rem; margin: 0 auto; }
.shot { margin: 1.1rem 0 .5rem; font-weight: 600; }
.shot small { font-weight: 400; color: var(--soft); margin-left: .5em; }
table { border-collapse: collapse; width: 100%; font-size: .92rem; }
th { text-align: left; color: var(--soft); font-weight: 600; }
td, th { padding: .34rem .7rem .34rem 0; border-bottom: 1px solid var(--grid);
  vertical-align: top; }
td:last-child { overflow-wrap: anywhere; }
tr:last-child td { border-bottom: 0; }
.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
.bar { width: 34%; }
.bar i { display: block; height: .75em; margin-top: .4em; border-radius: 3px;
  background: var(--accent); min-width: 2px; }
details summary { cursor: pointer; color: var(--accent); }
footer { color: var(--soft); font-size: .86rem; margin-top: 1.6rem; }
@media print { body { padding: 0; } section, .tile { break-inside: avoid; } }
"""
"""Colours of the frame classes are here, by the classes' names."""
