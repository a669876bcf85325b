"""The report's sections: each is a heading, one plain sentence, and what it is about."""

from __future__ import annotations

import base64
import html
import io
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.config import MediumConfig
from aquaflow.survey.coverage.classes import WORDS, CoverageClass
from aquaflow.survey.coverage.footprint import visibility
from aquaflow.survey.coverage.page_view import PageView
from aquaflow.survey.report.data import (
    CameraSummary,
    DepthProfile,
    HeldOutExample,
    LeftOut,
    MediumCurves,
    ReportData,
)
from aquaflow.survey.report.figures import coverage_svg, medium_svg, path_svg, profile_svg

IMAGE_WIDTH_PX = 720
"""Widest picture in the report; three stand side by side in 62 rem."""

TRANSPARENT = "#808080"
"""Shown where a picture is transparent: JPEG is not."""
JPEG_QUALITY = 88
"""Of the pictures in the report."""

MINIMUM_PATH = 2
"""Poses below which there is no path to draw."""

TILES = (
    ("tracked", "{:,.0f}", "frames with a pose"),
    ("keyframes", "{:,.0f}", "keyframes"),
    ("gaussians", "{:,.0f}", "Gaussians in the map"),
    ("fps", "{:.2f}", "frames per second"),
    ("psnr", "{:.2f}", "dB PSNR, held-out frames"),
    ("psnr_as_tracked", "{:.2f}", "dB PSNR, pose as tracked"),
    ("ssim", "{:.3f}", "SSIM, held-out frames"),
    ("flip", "{:.3f}", "FLIP, held-out frames"),
    ("lpips", "{:.3f}", "LPIPS, held-out frames"),
    ("ate_rmse_m_sim3", "{:.3g}", "path error (ATE, Sim(3))"),
)
"""Key of metrics.json, how it is written, and what it is."""

FRAME_CLASSES = {
    "keyframe": "keyframe: a new anchor of the map",
    "mapping": "mapping: added detail",
    "common": "common: tracked, nothing new",
    "skipped": "skipped: not worth looking at",
    "lost": "lost: no pose found",
    "dropped": "dropped: the picture was unusable",
}
"""Classes of frames as the report's key explains them, in the order in which it lists them."""

FOCAL_WORDS = {
    "calibrated": "from the calibration",
    "guessed": "guessed, as no calibration was given",
    "refined": "estimated from the dive, as no calibration was given",
}
"""Where the focal length comes from, in words."""


def warnings(data: ReportData) -> str:
    """What makes the dive's result poor, before anything else."""
    if not data.warnings:
        return ""
    items = "".join(f"<li>{html.escape(warning)}</li>" for warning in data.warnings)
    return _section("Look at this first", "This dive did not come out well.", f"<ul>{items}</ul>")


def tiles(metrics: Mapping[str, Any]) -> str:
    """The numbers that a pilot asks for first; what was not measured is left out."""
    cells = [
        f'<div class="tile"><b>{form.format(metrics[key])}</b><span>{label}</span></div>'
        for key, form, label in TILES
        if isinstance(metrics.get(key), int | float)
    ]
    return f'<div class="tiles">{"".join(cells)}</div>' if cells else ""


def path(data: ReportData) -> str:
    """The camera's path."""
    if data.path is None or np.isfinite(data.path.positions).all(axis=1).sum() < MINIMUM_PATH:
        return _section("The path", "No path was found: fewer than two frames have a pose.", "")
    said = "Where the camera went, seen from two sides"
    if data.path.up:
        said = "Where the camera went, seen from above and from the side"
    said += "; the dashed line is the true path." if data.path.truth is not None else "."
    if len(set(data.path.sub_maps)) > 1:
        said += " Tracking was lost on the way, so there are several sub-maps"
        said += (
            "; telemetry says how they lie to one another."
            if data.path.placed
            else ", and how they lie to one another is not known."
        )
    return _section("The path", said, path_svg(data.path))


def timeline(data: ReportData) -> str:
    """One stripe per frame in the colour of its class."""
    if not data.timeline:
        return ""
    stripes, at = [], 0
    for name, run in groupby(data.timeline):
        length = len(list(run))
        stripes.append(f'<rect x="{at}" width="{length}" height="1" fill="{_class_colour(name)}"/>')
        at += length
    counts = Counter(data.timeline)
    known = [name for name in FRAME_CLASSES if name in counts]
    key = "".join(
        f'<li><i style="background:{_class_colour(name)}"></i>{counts[name]:,} '
        f"{html.escape(FRAME_CLASSES.get(name, name))}</li>"
        for name in known + sorted(set(counts) - set(known))
    )
    strip = (
        f'<svg class="strip" viewBox="0 0 {at} 1" preserveAspectRatio="none" '
        f'shape-rendering="crispEdges" role="img">{"".join(stripes)}</svg>'
    )
    return _section(
        "Result of each frame",
        "The dive from its first frame (left) to its last (right).",
        f'{strip}<ul class="key">{key}</ul>',
    )


def _class_colour(name: str) -> str:
    return f"var(--{name})" if name in FRAME_CLASSES else "var(--grid)"


def examples(data: ReportData) -> str:
    """Held-out frames next to the map's rendering of the same view."""
    if not data.examples:
        return ""
    return _section(
        "Views that the map never saw",
        "These frames were kept from the mapper; the closer the rendering is to the camera's "
        "picture, the better the map.",
        "".join(_example(example) for example in data.examples),
    )


def _example(example: HeldOutExample) -> str:
    scores = []
    if example.psnr is not None:
        scores.append(f"PSNR {example.psnr:.2f} dB")
    if example.ssim is not None:
        scores.append(f"SSIM {example.ssim:.3f}")
    pictures = [("camera", example.real), ("rendered from the map", example.rendered)]
    if example.restored is not None:
        pictures.append(("the same without the water", example.restored))
    if example.confidence is not None:
        pictures.append(("white: restored from the picture", example.confidence))
    views = "".join(
        f'<figure><img alt="{label}" src="{_jpeg(image)}"><figcaption>{label}</figcaption></figure>'
        for label, image in pictures
    )
    return (
        f'<p class="shot">{html.escape(example.caption)}<small>{", ".join(scores)}</small></p>'
        f'<div class="views of{len(pictures)}">{views}</div>'
    )


def _jpeg(
    image: npt.NDArray[np.uint8],  # [H, W] grey, [H, W, 3] RGB or [H, W, 4] RGBA
) -> str:
    """A data URI of the picture, no wider than the report shows it; its transparent parts grey."""
    from PIL import Image

    picture = Image.fromarray(image)
    if picture.mode == "RGBA":
        backed = Image.new("RGBA", picture.size, TRANSPARENT)
        picture = Image.alpha_composite(backed, picture).convert("RGB")
    if picture.width > IMAGE_WIDTH_PX:
        height = max(1, round(picture.height * IMAGE_WIDTH_PX / picture.width))
        picture = picture.resize((IMAGE_WIDTH_PX, height), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def medium(data: ReportData) -> str:
    """The water's curves, or that there is no water worth modelling."""
    if data.medium is None:
        said = "No effect of the water above the noise was found, so none was modelled."
        return _section("The water", said, "")
    water = data.medium
    lost = [1.0 - float(np.exp(-value * water.range_p95)) for value in water.beta]
    worst = int(np.argmax(lost))
    after = (
        f"At {water.range_p95:.3g} {html.escape(water.unit)} the water has taken "
        f"{100 * lost[worst]:.0f} % of the {('red', 'green', 'blue')[worst]} light."
    )
    return _section(
        "The water",
        "How the water dims and veils the scene with distance; the shaded span is what this dive "
        "looked at, the rest is extrapolated.",
        f'{medium_svg(water)}<p class="after">{after}</p>',
    )


def stages(data: ReportData) -> str:
    """Where the time went."""
    if not data.stages:
        return ""
    ordered = sorted(data.stages.items(), key=lambda item: (-item[1]["total"], item[0]))
    longest = max(ordered[0][1]["total"], np.finfo(float).tiny)
    rows = "".join(
        f'<tr><td>{html.escape(name)}</td><td class="bar"><i style="width:'
        f'{100.0 * row["total"] / longest:.1f}%"></i></td>'
        f'<td class="n">{row["total"] / 1000.0:.2f}</td><td class="n">{row["count"]:,.0f}</td>'
        f'<td class="n">{row["p50"]:.1f}</td><td class="n">{row["p95"]:.1f}</td></tr>'
        for name, row in ordered
    )
    return _section(
        "Where the time went",
        "Time of each stage in total, and of one call: typical (p50) and slow (p95).",
        '<table><tr><th>stage</th><th></th><th class="n">total s</th><th class="n">calls</th>'
        f'<th class="n">p50 ms</th><th class="n">p95 ms</th></tr>{rows}</table>',
    )


def camera(summary: CameraSummary) -> str:
    """The camera, and how its focal length is known."""
    rows = (
        ("picture", f"{summary.width} x {summary.height} px"),
        ("focal length", f"{summary.focal_px:.1f} px, {FOCAL_WORDS[summary.focal_source]}"),
        ("lens distortion", summary.distortion_model),
    )
    said = "The camera of the mapped pictures; a wrong focal length bends the map."
    return _section("The camera", said, _table(rows))


def notes(data: ReportData) -> str:
    """What the reader has to know of the run; empty if there is nothing."""
    if not data.notes:
        return ""
    items = "".join(f"<li>{html.escape(note)}</li>" for note in data.notes)
    return _section("What to know", "What was left out or went wrong.", f"<ul>{items}</ul>")


def numbers(metrics: Mapping[str, Any]) -> str:
    """Every number of ``metrics.json``, but stages and notes, which have their own sections."""
    rows = [
        (key, "not measured" if value is None else _plain(value))
        for key, value in metrics.items()
        if key not in {"stage_ms", "notes"}
    ]
    if not rows:
        return ""
    return _section(
        "All numbers",
        "The content of metrics.json, for comparing dives.",
        f"<details><summary>show {len(rows)} values</summary>{_table(rows)}</details>",
    )


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, dict | list) else str(value)


def _table(rows: Any) -> str:
    return (
        "<table>"
        + "".join(
            f"<tr><td>{html.escape(str(key))}</td><td>{html.escape(str(value))}</td></tr>"
            for key, value in rows
        )
        + "</table>"
    )


def _section(title: str, sentence: str, body: str) -> str:
    return f"<section><h2>{title}</h2><p>{sentence}</p>{body}</section>"


# --------------------------------------------------------------------------------------------------
# The report's sections of a survey: coverage, depth over time, the water in numbers, what is not
# in the map.

Rows = list[tuple[str, ...]]


def coverage(data: ReportData) -> str:
    """What the camera has seen, from above, and beside it what that looks like."""
    view = data.coverage
    if view is None:
        return ""
    table = _survey_table(coverage_rows(view))
    return _survey_section(
        "What was seen", coverage_words(view), coverage_svg(view) + table
    ) + overview(data.overview, data.vertical)


def coverage_words(view: PageView) -> str:
    """How to read the plan view."""
    said = (
        "The ground in plan view: seen well is what at least as many keyframes as are wanted see "
        "from within the range that the water allows, and from more than one direction."
    )
    return said if view.plan.limit is not None else said + " No water was found that limits it."


def coverage_rows(view: PageView) -> Rows:
    """Areas, lines and overlap; without metres, or from aside, only shares."""
    areas, shares = view.areas, view.shares
    rows: Rows = []
    for seen in (CoverageClass.WELL, CoverageClass.SPARSE, CoverageClass.TOO_FAR):
        name = seen.name.lower()
        share = f"{100.0 * shares[name]:.0f} %"
        if areas is not None:
            share = f"{areas[name]:.3g} m\u00b2 ({share})"
        rows.append((WORDS[seen], share))
    state, limit = view.state, view.plan.limit
    if view.unit == "m":
        if limit is not None:
            rows.append(("range that the water allows", f"{limit * view.scale:.2g} m"))
        if state.lines:
            length = sum(line.length for line in state.lines)
            rows.append(("survey lines", f"{len(state.lines)}, together {length:.4g} m"))
            rows.append(("width of the swath", f"{state.swath:.3g} m"))
    if state.overlap is not None:
        said = f"{100.0 * state.overlap:.0f} % of the swath"
        if state.overlap < 0.0:
            said = f"none: a gap of {-100.0 * state.overlap:.0f} % of it"
        rows.append(("overlap of the last two lines", said))
    return rows


def overview(png: bytes | None, vertical: str) -> str:
    """The map from above, without water."""
    if png is None:
        return ""
    source = "data:image/png;base64," + base64.b64encode(png).decode("ascii")
    return _survey_section(
        "The map from above",
        f"Drawn from the map without water; vertical: {vertical}. aquaflow export --format ortho "
        "writes it as a GeoTIFF.",
        f'<figure class="overview"><img alt="the map from above" src="{source}"></figure>',
    )


def profile(data: DepthProfile | None) -> str:
    """Depth and altitude over time."""
    if data is None:
        return ""
    said = "As the vehicle measured them; the time is that of the recording."
    return _survey_section("Depth and altitude", said, profile_svg(data))


def water(data: MediumCurves | None) -> str:
    """The water in the numbers that a scientist asks for."""
    if data is None:
        return ""
    per = "per metre" if data.unit == "m" else "per map unit"
    said = (
        f"Rates are {per}, of the camera's red, green and blue; light is a share of the camera's "
        "full scale. Visibility is where an eye just sees a black target, 3.9 over the attenuation "
        "of the clearest channel (Koschmieder 1924)."
    )
    head = "<tr><th></th>" + "".join(f'<th class="n">{name}</th>' for name in RGB) + "</tr>"
    body = "".join(
        f"<tr><td>{html.escape(name)}</td>"
        + "".join(f'<td class="n">{value}</td>' for value in values)
        + "</tr>"
        for name, *values in water_rows(data)
    )
    seen = visibility_words(data) + lightness_words(data) + lamp_words(data)
    return _survey_section(
        "The water in numbers", said, f'<table>{head}{body}</table><p class="after">{seen}</p>'
    )


RGB = ("red", "green", "blue")
"""Channels in their order."""


def water_rows(data: MediumCurves) -> Rows:
    """Name and one value for each channel."""
    per = "1/m" if data.unit == "m" else "1/map unit"
    sigmas = data.beta_sigma or (None, None, None)
    halves = [np.log(2.0) / value if value > 0.0 else None for value in data.beta]
    rows: Rows = [
        (f"attenuation of the scene's light, {per}", *map(_with_sigma, data.beta, sigmas)),
        (f"half of the light is lost over, {data.unit}", *map(_with_sigma, halves, sigmas)),
        (f"backscatter coefficient, {per}", *map(_with_sigma, data.b)),
        ("backscatter of endless water, share", *map(_with_sigma, data.B_inf)),
    ]
    start = MediumConfig().initial_B_res
    learned = [abs(value / start - 1.0) > UNMOVED for value in data.B_res]
    if any(learned):
        for name, values in (
            ("near backscatter, share", data.B_res),
            (f"decay of near backscatter, {per}", data.d),
        ):
            known = zip(values, learned, strict=True)
            rows.append((name, *(_with_sigma(each) if at else "" for each, at in known)))
    if data.white is not None:
        name, *numbers = data.white
        gains = [
            f"{gain:.2f} \u00b1 {gain * sigma:.2f}" for gain, sigma in zip(*numbers, strict=True)
        ]
        rows.append((f"gain of the white balance, {name}", *gains))
    return rows


UNMOVED = 0.01
"""Change of the near backscatter from its start up to which neither it nor its decay was learned:
0.001 on two reefs."""


def _with_sigma(value: float | None, relative_sigma: float | None = None) -> str:
    """Empty where there is none."""
    if value is None:
        return ""
    return f"{value:.3f}" + (
        "" if relative_sigma is None else f" \u00b1 {value * relative_sigma:.3f}"
    )


def visibility_words(data: MediumCurves) -> str:
    """Visibility, and how sure the attenuation is, in sentences."""
    found = visibility(data.beta)
    if found is None:
        return "Visibility is not limited by the water that was found."
    looked = f"{data.range_p5:.2g} to {data.range_p95:.2g} {data.unit}"
    sure = (
        " How sure the attenuation is, is not known: the ranges that were seen allowed no fit."
        if data.beta_sigma is None
        else f" \u00b1 is 1 sigma; that of the visibility is {_sigma_of_clearest(data):.0%}."
    )
    said = f"Visibility: {found:.2g} {data.unit}; this dive looked {looked} far.{sure}"
    beyond = " It is extrapolated from what was looked at." if found > 2.0 * data.range_p95 else ""
    return html.escape(said + beyond)


def _sigma_of_clearest(data: MediumCurves) -> float:
    """Relative 1 sigma of the smallest attenuation."""
    return min(zip(data.beta, data.beta_sigma or (), strict=True))[1]


def lightness_words(data: MediumCurves) -> str:
    """How light the same ground is from far, in a sentence; none where too little was seen so."""
    if data.lightness is None:
        return ""
    seen, restored = data.lightness
    return (
        f" Ground seen from near and far is {seen:.0%} as light (CIELAB L*) from far as the camera "
        f"saw it, {restored:.0%} without the water."
    )


def lamp_words(data: MediumCurves) -> str:
    """The vehicle's lamps, in a sentence; none where none were found."""
    lamp = data.lamp
    if lamp is None:
        return ""
    by = "" if lamp.share_sigma is None else f" \u00b1 {lamp.share_sigma:.0%}"
    unit = html.escape(data.unit)
    said = (
        f" Lamps light the scene: {lamp.share:.0%}{by} of the light is theirs at {lamp.range:.2g} "
        f"{unit}, but for the water's loss on the way there"
    )
    if lamp.places is None or lamp.places_sigma is None:
        return said + "."
    places = " and ".join(f"({right:.2f}, {down:.2f})" for right, down in lamp.places)
    right, down = lamp.places_sigma
    return (
        f"{said}. They are {places} {unit} right of and below the camera, \u00b1 ({right:.2f}, "
        f"{down:.2f})."
    )


def left_out(rows: Sequence[LeftOut]) -> str:
    """Frames that are not in the map, by reason."""
    if not rows:
        return ""
    body = "".join(
        f"<tr><td>{html.escape(row.kind)}</td><td>{html.escape(row.reason)}</td>"
        f'<td class="n">{row.count:,}</td></tr>'
        for row in rows
    )
    return _survey_section(
        "What was left out, and why",
        "Frames without a pose, and those that could not help; frames.csv has each.",
        f'<table><tr><th>result</th><th>why</th><th class="n">frames</th></tr>{body}</table>',
    )


def _survey_table(rows: Rows) -> str:
    cells = "".join(
        f"<tr><td>{html.escape(name)}</td><td>{html.escape(value)}</td></tr>"
        for name, value in rows
    )
    return f"<table>{cells}</table>"


def _survey_section(title: str, sentence: str, body: str) -> str:
    return f"<section><h2>{title}</h2><p>{html.escape(sentence)}</p>{body}</section>\n"
