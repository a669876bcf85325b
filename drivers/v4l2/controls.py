"""Exposure, gain and white balance; what a camera lacks is a note, not an error."""

from __future__ import annotations

from dataclasses import dataclass

from aquaflow.config.cameras import V4l2Config
from aquaflow.drivers.v4l2 import abi
from aquaflow.drivers.v4l2.system import KernelInterface, call, supported


@dataclass(frozen=True)
class FixedControls:
    """What the camera confirmed; None where it decides for itself."""

    exposure_s: float | None
    gain: float | None
    notes: tuple[str, ...]


def apply_controls(system: KernelInterface, fd: int, config: V4l2Config) -> FixedControls:
    """Set what ``config`` fixes and read it back.

    Raises:
        OSError: the device is gone.
    """
    notes: list[str] = []

    def fix(what: str, automatic: tuple[int, int], control: int, wanted: int) -> int | None:
        # A camera without the automatic may still have the value, so its absence says nothing.
        supported(system, fd, abi.S_CTRL, abi.Control(*automatic))
        value = _set(system, fd, control, wanted)
        if value is None:
            notes.append(f"the camera has no fixed {what}; it decides for itself")
        return value

    exposure = gain = None
    if config.exposure_s is not None:
        exposure = fix(
            "exposure",
            (abi.CID_EXPOSURE_AUTO, abi.EXPOSURE_MANUAL),
            abi.CID_EXPOSURE_ABSOLUTE,
            max(1, round(config.exposure_s / abi.EXPOSURE_UNIT_S)),
        )
    if config.gain is not None:
        gain = fix("gain", (abi.CID_AUTOGAIN, 0), abi.CID_GAIN, config.gain)
    if config.white_balance_k is not None:
        fix(
            "white balance",
            (abi.CID_AUTO_WHITE_BALANCE, 0),
            abi.CID_WHITE_BALANCE_TEMPERATURE,
            config.white_balance_k,
        )
    exposure_s = None if exposure is None else exposure * abi.EXPOSURE_UNIT_S
    return FixedControls(exposure_s, None if gain is None else float(gain), tuple(notes))


def _set(system: KernelInterface, fd: int, control: int, wanted: int) -> int | None:
    """Set within the camera's range; what it then has, None if it has no such control."""
    limits = abi.QueryControl(id=control)
    if not supported(system, fd, abi.QUERYCTRL, limits):
        return None
    setting = abi.Control(control, max(limits.minimum, min(limits.maximum, wanted)))
    if not supported(system, fd, abi.S_CTRL, setting):
        return None
    call(system, fd, abi.G_CTRL, setting)
    return int(setting.value)
