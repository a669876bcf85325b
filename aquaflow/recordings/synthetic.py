"""A synthetic dive as a recording: its pictures and its simulated instruments."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from aquaflow.base.errors import AquaFlowError
from aquaflow.base.errors.regular_file import read_mapping
from aquaflow.config.stage import MountingConfig
from aquaflow.recordings.images import SUBFOLDER, ImageFolder
from aquaflow.recordings.sample_table import read_telemetry
from aquaflow.types import TelemetrySample

TELEMETRY = "telemetry.csv"
"""File of a synthetic dive."""


class SyntheticTelemetry:
    """Samples in the order of arrival, on the clock of the dive's pictures."""

    specificity = 2

    def __init__(self, folder: Path, starts_s: float = 0.0) -> None:
        """``starts_s`` is the time of the first picture on the caller's clock."""
        self.folder = folder
        self.notes: list[str] = []
        self._shift_ns = round(starts_s * 1e9)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return SyntheticDive.recognises(path) and (path / TELEMETRY).is_file()

    @classmethod
    def open(cls, path: Path, starts_s: float = 0.0) -> SyntheticTelemetry:
        return cls(path, starts_s)

    def samples(self) -> Iterator[TelemetrySample]:
        """Raises InputError where the file is damaged."""
        for sample in read_telemetry(self.folder / TELEMETRY):
            t_ns, arrival_ns = sample.t_ns + self._shift_ns, sample.arrival_ns + self._shift_ns
            yield replace(sample, t_ns=t_ns, arrival_ns=arrival_ns)

    def close(self) -> None:
        """Nothing stays open between passes."""


# --------------------------------------------------------------------------------------------------
# A synthetic dive as a camera.

MARK = "synth.yaml"
"""Only ``aquaflow lab synth`` writes this file."""


class SyntheticDive(ImageFolder):
    """A folder that ``aquaflow lab synth`` wrote: pictures, calibration and ground truth."""

    specificity = 2

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return (path / MARK).is_file() and (path / SUBFOLDER).is_dir()

    @classmethod
    def open(cls, path: Path, fps: float | None = None) -> SyntheticDive:
        return cls(path, fps)

    def stated_mounting(self) -> MountingConfig | None:
        """Stated mounting of the camera, as the dive states it; None where its synth.yaml does not
        say."""
        try:
            stated = read_mapping(self.folder / MARK, "facts of the dive", "write the dive again")
            return MountingConfig.model_validate(stated["mounting"]["camera"])
        except (AquaFlowError, KeyError, TypeError, ValueError):
            return None
