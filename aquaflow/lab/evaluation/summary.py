"""An evaluation's JSON in words: what was measured, in the order in which a reader asks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from aquaflow.lab.evaluation.water_peers.contract import NAMES

Values = Mapping[str, Any]

LABEL_WIDTH = 32
"""Characters of the first column."""


def in_words(result: Values) -> list[str]:
    """Lines for the terminal; parts that were not evaluated are left out."""
    lines: list[str] = []
    if "posed" in result:
        lines += _trajectory(result)
        lines += _metric(result)
        lines += _views(result)
    if "epipolar" in result:
        lines += _epipolar(result["epipolar"])
    if result.get("medium_error"):
        lines += _water(result["medium_error"])
    if result.get("naturalness"):
        lines += _naturalness(result["naturalness"])
    if "restoration" in result:
        lines += _restoration(result["restoration"])
    return lines + [f"Note: {note}." for note in result.get("notes", [])]


def _row(label: str, text: str) -> str:
    return f"  {label:<{LABEL_WIDTH - 2}}  {text}"


def _trajectory(result: Values) -> list[str]:
    lines = [
        "Trajectory (distances in the truth's unit)",
        _row(
            "posed",
            f"{result['posed']} of {result['frames']} frames, {result['matched']} of them compared",
        ),
        _row("path", f"{result['path_length']:.4g}"),
    ]
    for kind, title in (("sim3", "error, Sim(3) aligned"), ("se3", "error, SE(3) aligned")):
        error, share = result[f"ate_rmse_m_{kind}"], result[f"ate_pct_{kind}"]
        lines.append(_row(title, f"{error:.4g} rms, {share:.3g} % of the path"))
    if result["rotation_rmse_deg"] is not None:
        lines.append(_row("rotation error", f"{result['rotation_rmse_deg']:.3g} degrees rms"))
    if result["drift_pct"] is not None:
        lines.append(_row("drift at the end", f"{result['drift_pct']:.3g} % of the path"))
    relative = result["rpe"]
    if relative is not None:
        moved, turned = relative["translation_pct"], relative["rotation_rmse_deg"]
        lines.append(_row("pose to pose (RPE)", f"{moved:.3g} % of the step, {turned:.3g} degrees"))
    return lines


def _metric(result: Values) -> list[str]:
    """Metres, gravity and north of the dive as it states them."""
    metric = result.get("metric")
    if metric is None:
        return []
    lines = [
        "Metres, gravity and north as the dive states them",
        _row("scale error", _error_in_words(metric, "scale", "pct", "%")),
    ]
    if metric["gravity_error_deg"] is not None:
        lines.append(_row("gravity error", _error_in_words(metric, "gravity", "deg", "degrees")))
    if metric["heading_error_deg"] is not None:
        lines.append(_row("heading error", _error_in_words(metric, "heading", "deg", "degrees")))
    if metric["ate_rmse_m_level"] is not None:
        said = f"{metric['ate_rmse_m_level']:.4g} m rms, only turned about the vertical and shifted"
        lines.append(_row("error, level", said))
    return lines


def _error_in_words(metric: Values, what: str, unit: str, word: str) -> str:
    """An error with its stated sigma, and how many of them it is."""
    said = f"{metric[f'{what}_error_{unit}']:.3g} {word}"
    sigma, sigmas = metric[f"{what}_sigma_{unit}"], metric[f"{what}_error_sigmas"]
    if sigmas is None:
        return said
    return f"{said}, {abs(sigmas):.2g} times its stated sigma of {sigma:.3g}"


def _epipolar(error: Values) -> list[str]:
    """One line for every distance in time."""
    lines = [
        f"Epipolar distance of keypoint matches, median, px of {error['width_px']} px wide pictures"
    ]
    for gap in error["gaps"]:
        true = "" if gap["truth_px"] is None else f", truth {gap['truth_px']:.2f}"
        said = f"dive {gap['dive_px']:.2f}{true}, best fit of each pair {gap['best_px']:.2f}"
        lines.append(_row(f"{gap['gap_s']:.2f} s apart", f"{said} ({gap['matches']} matches)"))
    return lines


def _views(result: Values) -> list[str]:
    if result.get("psnr") is None:
        return []
    said = f"PSNR {result['psnr']:.2f} dB, SSIM {result['ssim']:.3f}"
    for key, name in (("flip", "FLIP"), ("lpips", "LPIPS"), ("lpips_alex", "LPIPS (AlexNet)")):
        if result.get(key) is not None:
            said += f", {name} {result[key]:.3f}"
    rows = [_row("as the camera saw them", said)]
    if result.get("psnr_as_tracked") is not None:
        psnr, ssim = result["psnr_as_tracked"], result["ssim_as_tracked"]
        rows.append(_row("pose as in trajectory.tum", f"PSNR {psnr:.2f} dB, SSIM {ssim:.3f}"))
    return ["Held-out views (measured while mapping)", *rows]


def _water(error: Values) -> list[str]:
    if not error["active"]:
        return ["Water", _row("medium", "switched off: the dive found the water clear")]
    low, high = error["backscatter_span_m"]
    return [
        "Water (red, green, blue)",
        _row("attenuation, 1/m", _rgb(error["attenuation_per_m"])),
        _row("true attenuation, 1/m", _rgb(error["true_attenuation_per_m"])),
        _row("recovered / true", _rgb(error["attenuation_ratio"])),
        _row("backscatter error", f"{error['backscatter_rmse']:.3g} from {low:g} to {high:g} m"),
    ]


def _naturalness(near: Values) -> list[str]:
    hue = "the camera's picture is grey there"
    if near["hue_shift_deg"] is not None:
        hue = (
            f"{near['hue_shift_deg']:.1f} degrees, at most {near['largest_hue_shift_deg']:.1f}, in "
            f"{near['hue_views']} of {near['views']} views"
        )
    return [
        "What is nearest, restored against the camera's picture (CIELAB)",
        _row("hue shift", hue),
        _row("chroma difference", f"{near['chroma_difference']:+.1f}"),
        _row("lightness ratio", f"{near['lightness_ratio']:.2f}"),
    ]


def _restoration(restored: Values) -> list[str]:
    return [
        "Without water (one gain per channel)",
        _row("restored", f"{restored['psnr_restored']:.2f} dB on {restored['frames']} frames"),
        _row("raw", f"{restored['psnr_raw']:.2f} dB"),
        _row("gain", f"{restored['gain_db']:+.2f} dB"),
        *(_row(title, _peer(restored, name)) for name, title in NAMES.items()),
    ]


def _peer(restored: Values, name: str) -> str:
    found = restored[f"psnr_{name}"]
    return f"{found:.2f} dB" if found is not None else f"- ({restored['peer_reasons'][name]})"


def _rgb(values: Sequence[float | None]) -> str:
    return ", ".join("-" if value is None else f"{value:.3g}" for value in values)
