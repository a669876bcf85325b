"""A synthetic dive as a camera."""

from __future__ import annotations

from pathlib import Path

from sim_drivers.images import SUBFOLDER, ImageFolder

MARK = "synth.yaml"
"""Only ``aquaflow synth`` writes this file."""


class SyntheticDive(ImageFolder):
    """A folder that ``aquaflow synth`` wrote: pictures, calibration and ground truth."""

    specificity = 2

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return (path / MARK).is_file() and (path / SUBFOLDER).is_dir()

    @classmethod
    def open(cls, path: Path, fps: float | None = None) -> SyntheticDive:
        return cls(path, fps)
