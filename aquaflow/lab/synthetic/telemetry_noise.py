"""The simulated instruments: rates and errors, each with its unit and where it is from.

The defaults are those of a BlueROV2 with a DVL and an altimeter. A sigma or share of 0 leaves its
error out, a rate of 0 its instrument.
"""

from __future__ import annotations

from datetime import datetime, timezone

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field


class TelemetryNoise(BaseModel):
    """Rates and errors of the simulated instruments."""

    model_config = ConfigDict(extra="forbid")

    depth_hz: float = Field(10.0, ge=0, description="Hz; Bar30-class depth cell over MAVLink")
    depth_sigma_m: float = Field(0.01, ge=0, description="m; Bar30 short-term noise is about 1 cm")
    depth_resolution_m: float = Field(
        0.002, ge=0, description="m; MS5837-30BA data sheet: 0.2 mbar, 2 mm of water"
    )
    depth_offset_sigma_m: float = Field(
        0.1,
        ge=0,
        description="m, 1 sigma, drawn once: zeroed below the surface, or before the air pressure "
        "changed by 10 hPa (judgement; the cell's own is 2 m, which zeroing removes)",
    )
    tide_amplitude_m: float = Field(
        1.0,
        ge=0,
        description="m; half the range on many coasts of Norway and Japan (judgement)",
    )
    tide_period_s: float = Field(44_714.0, gt=0, description="s; principal lunar tide M2, 12.42 h")
    wave_height_m: float = Field(
        0.3, ge=0, description="m, crest to trough; WMO sea state 2, in which small ROVs are used"
    )
    wave_period_s: float = Field(4.0, gt=0, description="s; wind sea of a sheltered coast")

    attitude_hz: float = Field(20.0, ge=0, description="Hz; ATTITUDE stream of an autopilot")
    attitude_sigma_deg: float = Field(
        0.1, ge=0, description="degrees per body axis, white; twice the resolution of an Xsens MTi"
    )
    tilt_wander_sigma_deg: float = Field(
        0.5,
        ge=0,
        description="degrees of roll and of pitch, wandering; Xsens MTi-30 manual: 0.5 RMS dynamic",
    )
    tilt_wander_s: float = Field(
        20.0, gt=0, description="s, correlation time; an AHRS averages accelerations so long"
    )
    heading_offset_sigma_deg: float = Field(
        4.0,
        ge=0,
        description="degrees, drawn once; Cerulean ROV Locator manual: compass error of an ROV "
        "typically 3 to 5",
    )
    heading_wander_sigma_deg: float = Field(
        2.0, ge=0, description="degrees, wandering: thruster currents, steel nearby (judgement)"
    )
    heading_wander_s: float = Field(60.0, gt=0, description="s, correlation time (judgement)")

    rate_hz: float = Field(50.0, ge=0, description="Hz; raw gyro stream of an autopilot")
    rate_sigma_rad_s: float = Field(
        0.002, ge=0, description="rad/s; 0.01 deg/s/sqrt(Hz) MEMS gyro over 50 Hz, rounded up"
    )
    rate_bias_sigma_rad_s: float = Field(
        0.002,
        ge=0,
        description="rad/s per axis, drawn once: what moved since the calibration on deck; an "
        "ICM-20602 by 0.2 deg/s in three hours (InvenSense user forum)",
    )
    rate_bias_walk: float = Field(
        2e-5, ge=0, description="rad/s/sqrt(s); ADIS16448 of the EuRoC data set, 1.94e-5"
    )
    acceleration_hz: float = Field(50.0, ge=0, description="Hz; raw stream of an autopilot")
    acceleration_sigma_m_s2: float = Field(
        0.1,
        ge=0,
        description="m/s^2; vibration of the thrusters (judgement; the ICM-20602's own noise, "
        "100 ug/sqrt(Hz), is 0.005)",
    )
    acceleration_bias_sigma_m_s2: float = Field(
        0.05, ge=0, description="m/s^2 per axis, drawn once; 5 mg are left by a calibration by hand"
    )

    dvl_hz: float = Field(5.0, ge=0, description="Hz; DVL-A50-class, 4 to 15 Hz with altitude")
    dvl_sigma_m_s: float = Field(
        0.01, ge=0, description="m/s per axis, white; the true value of the figure of merit"
    )
    dvl_merit_spread: float = Field(
        0.3, ge=0, description="log-normal sigma of the reported figure of merit (judgement)"
    )
    dvl_scale_sigma: float = Field(
        0.001,
        ge=0,
        description="relative, 1 sigma of the scale factor, drawn once; Water Linked DVL-A50 "
        "PERFORMANCE data sheet: long-term accuracy 0.1 % (the standard edition: 1 %)",
    )
    dvl_dropout_share: float = Field(
        0.02, ge=0, le=1, description="of samples that are missing one by one (judgement)"
    )
    dvl_lock_losses_per_min: float = Field(
        0.5, ge=0, description="losses of bottom lock per minute (judgement: steep relief, kelp)"
    )
    dvl_lock_loss_s: float = Field(3.0, ge=0, description="s, mean duration of one (judgement)")

    altitude_hz: float = Field(
        10.0, ge=0, description="Hz; Ping Sonar, whose interval is 50 to 200 ms near the floor"
    )
    altitude_beam_deg: float = Field(
        25.0, gt=0, le=60, description="degrees, full width; Blue Robotics Ping Sonar manual"
    )
    altitude_sigma_m: float = Field(
        0.01, ge=0, description="m; a cycle of 115 kHz, at which an echo begins, is 1.3 cm of water"
    )
    altitude_resolution_m: float = Field(
        0.01, ge=0, description="m; Ping Sonar: 0.5 % of the scanned range, 2 m near the floor"
    )
    altitude_multipath_share: float = Field(
        0.02,
        ge=0,
        le=1,
        description="of samples that are the second echo, at twice the range (judgement)",
    )
    altitude_shortest_m: float = Field(0.3, ge=0, description="m; Blue Robotics Ping Sonar")
    altitude_longest_m: float = Field(100.0, gt=0, description="m; Blue Robotics Ping Sonar manual")

    position_hz: float = Field(
        0.0, ge=0, description="Hz of acoustic fixes (USBL); 0: none, as on most small ROVs"
    )
    position_sigma_m: float = Field(
        1.0,
        ge=0,
        description="m, north and east, also reported; Cerulean ROV Locator: 2 degrees of bearing, "
        "1 m at a slant range of 30 m",
    )
    position_lag_s: float = Field(
        0.5,
        ge=0,
        description="s by which a fix is stamped too late: travel time and filter (judgement)",
    )
    position_outlier_share: float = Field(
        0.05, ge=0, le=1, description="of fixes, from echoes off hull and surface (judgement)"
    )
    position_outlier_sigma_m: float = Field(
        10.0, ge=0, description="m, of the outliers' own error; reported as any other (judgement)"
    )
    origin_latitude_deg: float = Field(
        63.45, ge=-89, le=89, description="degrees (WGS 84) of x = y = 0; Trondheimsfjorden"
    )
    origin_longitude_deg: float = Field(10.40, ge=-180, le=180, description="degrees (WGS 84)")
    utc_hz: float = Field(0.1, ge=0, description="Hz; SYSTEM_TIME of an autopilot, thinned out")
    starts_utc: AwareDatetime = Field(
        datetime(2026, 6, 1, 8, 0, tzinfo=timezone.utc), description="UTC of the first picture"
    )

    latency_s: float = Field(0.03, ge=0, description="s; mean delay from measurement to arrival")
    starts_late_s: float = Field(
        0.0, ge=0, description="s from the first picture to the start of the vehicle's log"
    )
