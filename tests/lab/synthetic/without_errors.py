"""Simulated instruments without errors."""

from __future__ import annotations

from aquaflow.lab.synthetic.telemetry_noise import TelemetryNoise

WITHOUT_ERRORS = {
    name: 0.0
    for name in TelemetryNoise.model_fields
    if "sigma" in name or "share" in name or "resolution" in name or "per_min" in name
} | {"rate_bias_walk": 0.0, "tide_amplitude_m": 0.0, "wave_height_m": 0.0, "dvl_merit_spread": 0.0}
"""Every sigma, share and amplitude is 0; rates, delays and ranges are the usual ones."""
