"""A synthetic dive as a camera."""

from __future__ import annotations

from pathlib import Path

from aquaflow.base.errors import AquaFlowError
from aquaflow.base.errors.regular_file import read_mapping
from aquaflow.config.stage import MountingConfig
from aquaflow.recordings.images import SUBFOLDER, ImageFolder

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
        """Of the camera, as the dive states it; None where its synth.yaml does not say."""
        try:
            stated = read_mapping(self.folder / MARK, "facts of the dive", "write the dive again")
            return MountingConfig.model_validate(stated["mounting"]["camera"])
        except (AquaFlowError, KeyError, TypeError, ValueError):
            return None
