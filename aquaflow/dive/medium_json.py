"""The content of medium.json: the water of the largest sub-map with its units."""

from __future__ import annotations

from typing import Any

from aquaflow.dive.results import WaterSummary
from aquaflow.telemetry.world_frame import WorldFrame


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
            "white_balance": "as the camera saw what was at near_range",
            "near_range": water.near_range,
            "amplification": amplification
            and dict(zip(("applied", "allowed"), amplification, strict=True)),
        },
        "colour_variance_over_range": water.range_variance
        and dict(zip(("seen", "restored"), water.range_variance, strict=True)),
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
