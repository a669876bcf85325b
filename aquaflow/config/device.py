"""Settings that every telemetry device has, and where it is mounted."""

from __future__ import annotations

from pydantic import Field

from aquaflow.config.stage import StageConfig


class MountingConfig(StageConfig):
    """Where a sensor sits in the body frame (forward, right, down)."""

    position_m: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="of the sensor, from the body's origin"
    )
    roll_deg: float = Field(0.0, description="of the sensor's axes in the body, first roll")
    pitch_deg: float = Field(0.0, description="then pitch")
    yaw_deg: float = Field(
        0.0,
        description="then yaw; 180: a DVL that points backwards, unless it turns what it sends",
    )


class DeviceConfig(StageConfig):
    """What every device has."""

    mounting: MountingConfig = MountingConfig()
    silence_s: float | None = Field(
        10.0, gt=0, description="open the link anew after this long without a byte (None: never)"
    )


class PositioningConfig(DeviceConfig):
    """A device that may send fixes on the earth: GNSS, or an acoustic system of the vehicle."""

    position_lag_s: float = Field(
        0.0,
        ge=0,
        le=60,
        description="s that a fix is older than its message says. GNSS receivers: 0.1 to 0.25 "
        "(ArduPilot's GPS1_DELAY_MS ends at 250); acoustic systems more: 0.2 for the sound over "
        "300 m at 1500 m/s, the wait between two pulses, and their filter",
    )
    position_sigma_m: float | None = Field(
        None,
        gt=0,
        description="m, 1 sigma of each horizontal direction of every fix, such as an acoustic "
        "system's data sheet has it; None: as the device states it, else from HDOP",
    )


class Assumptions(StageConfig):
    """What may be assumed where a device measures only part of a quantity.

    A heading without roll and pitch is no attitude. With ``level`` it becomes one: true within the
    few degrees by which a passively stable ROV leans, wrong for gravity on any other vehicle.
    """

    level: bool = Field(False, description="roll and pitch are 0 where nothing measures them")
    no_side_slip: bool = Field(False, description="the vehicle moves only where it points")
    speed_sigma_m_s: float = Field(
        0.2, gt=0, description="m/s, 1 sigma of a velocity that only a speed log measures"
    )
