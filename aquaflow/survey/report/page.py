"""The report's page: sections in the order in which a reader asks."""

from __future__ import annotations

import html
from pathlib import Path

from aquaflow.base.errors import printable_text
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.survey.report import measures, sections, survey_sections
from aquaflow.survey.report.data import ReportData
from aquaflow.survey.report.style import STYLE_SHEET


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
        survey_sections.coverage(data),
        survey_sections.profile(data.profile),
        measures.reef(data.reef),
        measures.measures(data.measures),
        sections.examples(data),
        sections.medium(data),
        survey_sections.water(data.medium),
        sections.timeline(data),
        survey_sections.left_out(data.left_out),
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
