"""Results of a finished run: poses, water (medium.json) and metrics.json's numbers."""

from __future__ import annotations

import resource
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from aquaflow import __version__
from aquaflow.dive.held_out_example import HeldOut, Perceived
from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.render.transfer_counts import transfers
from aquaflow.slam import Slam
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.consistency import scale_drift
from aquaflow.tracking.frames import FrameClass, Tracked
from aquaflow.types import Dropped
from aquaflow.water.mounting import Lamp

PROTOCOL = {
    "held_out": "i % n == 0 and i != 0 of the used frames: tracked, never mapped; pose refined "
    "photometrically against the frozen map; exposure and sunlight, where views differ in them, "
    "those between the mapped frames before and after",
    "resolution": "the width that was mapped, undistorted",
    "ssim": "11x11 Gaussian window, sigma 1.5 px, zero-padded, mean over channels",
    "psnr": "mean over held-out frames of the PSNR of each",
    "flip": "mean over held-out frames of the mean of each, at 67 pixels for each degree",
    "lpips": "version 0.1; lpips by VGG16's features, lpips_alex by AlexNet's",
    "as_tracked": "psnr and ssim before that refinement: pose as tracked, moved with the mapped "
    "frames before and after",
    "ate": "see `aquaflow lab evaluate`, which knows the truth",
}
"""How the numbers of metrics.json were measured."""


@dataclass(frozen=True)
class WaterSummary:
    """The medium of one sub-map, mean over its views; rates and ranges in one unit of length, that
    of the map unless something else is said."""

    beta_a: list[float]
    b: list[float]
    B_inf: list[float]
    B_res: list[float]
    d: list[float]
    range_p5: float
    range_median: float
    range_p95: float
    white_gain: list[float]
    """Of the clean radiance in restored pictures and map_clear.ply, in all."""
    white_choice: str
    """:attr:`aquaflow.water.white_balance.ChosenWhite.name`."""
    chosen_gain: list[float]
    """What of ``white_gain`` comes on top of the camera's white balance."""
    chosen_gain_sigma: list[float] | None
    """Its relative standard deviation; None for the camera's."""
    near_range: float | None
    """Range whose colours restored pictures keep; None if there was no fit."""
    range_variance: tuple[float, float] | None
    """Relative variance of the points' colours that follows from their range: seen, restored."""
    lightness_over_range: tuple[float, float] | None
    """L* of the same ground, far over near: seen, restored."""
    beta_a_sigma: list[float] | None
    """Relative standard deviation of beta_a; None if the ranges seen never allowed a fit."""
    shading: list[float]
    """Log-gain of the camera over the picture: x, y, x^2, x y, y^2 with x, y from -1 to 1."""
    unevenness: list[float]
    """Log-gain of the backscatter over the picture, in the same terms."""
    lamp: Lamp | None
    """Light from beside the camera; None where none was found."""
    exposure: float
    """One gain of all that is restored, on top of ``white_gain``."""
    highlight_compression: float
    """Of their highlights, see :class:`aquaflow.water.tone.ShownTone`."""


def largest_sub_map(results: list[Tracked]) -> int:
    """The sub-map with the most posed frames; the earliest of equals."""
    posed = [tracked.sub_map for tracked in results if tracked.T_wc is not None]
    return max(sorted(set(posed)), key=posed.count, default=0)


def tracked_poses(results: list[Tracked]) -> dict[int, Sim3]:
    """T_wc by frame index, of the frames that have one."""
    return {tracked.frame.index: tracked.T_wc for tracked in results if tracked.T_wc is not None}


def refined_poses(slam: Slam, results: list[Tracked]) -> dict[int, Sim3]:
    """Pose by frame index. Frames that a map was optimised against are where it refined them, the
    others as tracked, moved in the camera's axes by what moved the refined before and after them.
    """
    poses = tracked_poses(results)
    sub_maps = {tracked.frame.index: tracked.sub_map for tracked in results}
    for sub_map, mapper in slam.mappers.items():
        own = {index: T_wc for index, T_wc in poses.items() if sub_maps[index] == sub_map}
        refined = {view.frame_index: view.T_wc for view in mapper.views if view.T_wc.is_finite()}
        poses |= moved_with(own, refined)
    return poses


def moved_with(poses: Mapping[int, Sim3], refined: Mapping[int, Sim3]) -> dict[int, Sim3]:
    """``refined`` by frame index, and the ``poses`` between them moved as those were; as little
    before the first and after the last."""
    known = sorted(refined.keys() & poses.keys())
    between = [index for index in poses if index not in refined]
    if not known or not between:
        return dict(refined)
    before, after = (Sim3Batch.of([_rigid(each[at]) for at in known]) for each in (poses, refined))
    moves = (before.inverse() @ after).log()
    # All at once: one by one an hour's poses took minutes, each with a copy of what is known.
    parts = np.column_stack([np.interp(between, known, part) for part in moves.T])
    found = Sim3Batch.of([_rigid(poses[index]) for index in between]) @ Sim3Batch.exp(parts)
    moved = {
        index: Sim3(found.R[i], found.t[i], poses[index].scale) for i, index in enumerate(between)
    }
    return moved | dict(refined)


def _rigid(T_wc: Sim3) -> Sim3:
    """The camera's axes with the world's unit: refining moves nothing else."""
    return Sim3(T_wc.R, T_wc.t)


def metrics(
    slam: Slam,
    results: list[Tracked],
    dropped: list[Dropped],
    held_out: list[HeldOut],
    wall_s: float,
) -> dict[str, Any]:
    """The stable keys of metrics.json (docs/formats.md#metrics-json)."""
    classes = [tracked.frame_class for tracked in results]
    posed = sum(tracked.T_wc is not None for tracked in results)
    renderer = slam.renderer
    counts = {"frames": len(results) + len(dropped), "tracked": posed}
    counts |= {
        "lost": classes.count(FrameClass.LOST),
        "skipped": classes.count(FrameClass.SKIPPED) + len(dropped),
        "keyframes": classes.count(FrameClass.KEYFRAME),
        "mapping_frames": classes.count(FrameClass.MAPPING),
        "common_frames": classes.count(FrameClass.COMMON),
    }
    drift = scale_drift(slam.graph.snapshot, slam.keyframes.keyframes)
    as_tracked = [example.as_tracked for example in held_out if example.as_tracked is not None]
    return counts | {
        "complete": True,
        "sub_maps": len({t.sub_map for t in results if t.T_wc is not None}),
        "skipped_by": dict(slam.skipped) | ({"dropped": len(dropped)} if dropped else {}),
        "loops": slam.graph.loops,
        "adjustments": slam.adjuster.tally.to_json(),
        "consistency": slam.tracker.monitor.counts.to_json(),
        "scale_drift": None if drift is None else drift.to_json(),
        "gaussians": sum(len(mapper.gaussians) for mapper in slam.mappers.values()),
        "steps": sum(mapper.steps for mapper in slam.mappers.values()),
        "steps_undone": sum(mapper.undone for mapper in slam.mappers.values()),
        "wall_s": round(wall_s, 3),
        "fps": round((len(results) + len(dropped)) / max(wall_s, 1e-9), 3),
        "stage_ms": slam.profiler.summary(),
        "peak_rss_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0, 1),
        "psnr": _mean([example.psnr for example in held_out]),
        "ssim": _mean([example.ssim for example in held_out]),
        "psnr_as_tracked": _mean([before.psnr for before in as_tracked]),
        "ssim_as_tracked": _mean([before.ssim for before in as_tracked]),
        **_perceived(slam, [example.perceived for example in held_out]),
        "heldout_frames": len(held_out),
        "ate_rmse_m_se3": None,
        "ate_rmse_m_sim3": None,
        "rpe": None,
        "renderer": None
        if renderer is None
        else f"{renderer.name} ({renderer.isa}, {renderer.threads} threads)",
        "prior": slam.prior.name,
        "matching": slam.prior.matching,
        "device": None if renderer is None else renderer.device.type,
        "transfers": transfers(),
        "seed": slam.config.seed,
        "version": __version__,
        "protocol": PROTOCOL,
    }


def _perceived(slam: Slam, views: list[Perceived]) -> dict[str, float | str | None]:
    """Means over the views, and why LPIPS has none."""
    reason: str | None = "mapping is off"
    if slam.renderer is not None:
        from aquaflow.render.lpips import load_lpips  # loads torch

        _, reason = load_lpips(slam.config.mapping.lpips_weights)
    return {
        "flip": _mean([view.flip for view in views]),
        "lpips": _mean([view.lpips for view in views]),
        "lpips_alex": _mean([view.lpips_alex for view in views]),
        "lpips_reason": reason,
    }


def _mean(values: Sequence[float | None]) -> float | None:
    """Of those that are known; None where none is."""
    known = [value for value in values if value is not None]
    return round(float(np.mean(known)), 4) if known else None


# --------------------------------------------------------------------------------------------------
# The content of medium.json: the water of the largest sub-map with its units.


def medium_json(
    water: WaterSummary | None,
    frame: WorldFrame,
    evidence: float | None = None,
    amplification: tuple[list[float], list[float]] | None = None,
) -> dict[str, Any]:
    """Parameters, their units, and the range at which map.ply is shown.

    Args:
        water: with rates and ranges in the unit of ``frame``; None while the medium is off.
        frame: of the same sub-map.
        evidence: log odds of water against clear water or none, before the prior's 5 are added.
        amplification: of held-out views, see
            :func:`aquaflow.dive.held_out_example.mean_amplification`.
    """
    data: dict[str, Any] = {"active": water is not None, "scale_source": frame.scale_source}
    if frame.metric:
        data["unit"] = frame.unit
    data["evidence"] = evidence
    if water is None:
        return data
    per_unit = "1/m" if frame.metric else "1/map unit"
    return data | {
        "attenuation_per_unit": water.beta_a,
        "attenuation_unit": per_unit,
        "backscatter": {
            "B_inf": water.B_inf, "b": water.b, "B_res": water.B_res, "d": water.d,
        },
        "attenuation_relative_sigma": water.beta_a_sigma,
        "identifiable": water.beta_a_sigma is not None,
        "restored": {
            "gain": water.white_gain,
            "exposure": water.exposure,
            "highlight_compression": water.highlight_compression,
            "white_balance": {
                "choice": water.white_choice,
                "gain": water.chosen_gain,
                "sigma": water.chosen_gain_sigma,
            },
            "near_range": water.near_range,
            "amplification": amplification
            and dict(zip(("applied", "allowed"), amplification, strict=True)),
        },
        "colour_variance_over_range": water.range_variance
        and dict(zip(("seen", "restored"), water.range_variance, strict=True)),
        "lightness_over_range": water.lightness_over_range
        and dict(zip(("seen", "restored"), water.lightness_over_range, strict=True)),
        "lamp": water.lamp and asdict(water.lamp),
        "shading_log_gain": water.shading,
        "backscatter_log_gain": water.unevenness,
        "log_gain_terms": ["x", "y", "x^2", "x y", "y^2"],
        "units": {
            "attenuation, b, d": per_unit,
            "B_inf, B_res": "share of the camera's full scale",
            "log gains": "natural logarithm; x and y run from -1 to 1 over the picture",
        },
        "range_p5": water.range_p5,
        "range_p95": water.range_p95,
        "map_ply_reference_range": water.range_median,
    }  # fmt: skip
