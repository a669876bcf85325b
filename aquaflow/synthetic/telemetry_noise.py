"""The simulated instruments: rates and errors, each with its unit and where it is from."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["TelemetryNoise"]


class TelemetryNoise(BaseModel):
    """Rates and one-sigma white noise of the simulated instruments."""

    model_config = ConfigDict(extra="forbid")

    depth_hz: float = Field(10.0, gt=0, description="Hz; Bar30-class depth cell over MAVLink")
    depth_sigma_m: float = Field(0.01, ge=0, description="m; Bar30 short-term noise is about 1 cm")
    attitude_hz: float = Field(20.0, gt=0, description="Hz; ATTITUDE stream of an autopilot")
    attitude_sigma_deg: float = Field(
        0.5, ge=0, description="degrees per body axis; typical MEMS AHRS in motion"
    )
    rate_hz: float = Field(50.0, gt=0, description="Hz; raw gyro stream of an autopilot")
    rate_sigma_rad_s: float = Field(
        0.002, ge=0, description="rad/s; 0.01 deg/s/sqrt(Hz) MEMS gyro over 50 Hz, rounded up"
    )
    dvl_hz: float = Field(5.0, gt=0, description="Hz; DVL-A50-class, 4 to 15 Hz with altitude")
    dvl_sigma_m_s: float = Field(
        0.01, ge=0, description="m/s per axis, also reported as the figure of merit"
    )
    dvl_scale_sigma: float = Field(
        0.001,
        ge=0,
        description="relative, 1 sigma of the scale factor, drawn once; Water Linked DVL-A50 "
        "PERFORMANCE data sheet: long-term accuracy 0.1 % (the standard edition: 1 %)",
    )
    altitude_hz: float = Field(10.0, gt=0, description="Hz; Ping Sonar at ranges of some metres")
    altitude_beam_deg: float = Field(
        25.0, gt=0, le=60, description="degrees, full width; Blue Robotics Ping Sonar manual"
    )
    altitude_sigma_m: float = Field(0.01, ge=0, description="m; Ping Sonar")
    altitude_resolution_m: float = Field(0.01, ge=0, description="m; Ping Sonar")
    altitude_multipath_share: float = Field(
        0.02, ge=0, le=1, description="of samples that are twice the range; judgement"
    )
    altitude_shortest_m: float = Field(0.3, ge=0, description="m; Ping Sonar")
    altitude_longest_m: float = Field(100.0, gt=0, description="m; Blue Robotics Ping Sonar manual")
    latency_s: float = Field(0.03, ge=0, description="s; mean delay from measurement to arrival")
