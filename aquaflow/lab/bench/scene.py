"""A scene of the benchmark: a recording, what is true about it, and how to open it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from aquaflow.base.errors import InputError
from aquaflow.lab.evaluation.restoration import SYNTHETIC_MARK


@dataclass(frozen=True)
class BenchmarkScene:
    """Paths are strings, so that a scene travels to the worker as JSON."""

    name: str
    recording: str
    truth: str | None = None
    """What ``lab evaluate --truth`` takes; None: only time and held-out quality are measured."""
    calibration: str | None = None
    clean: str | None = None
    """The same recording without water."""
    clean_crop: str | None = None
    overrides: dict[str, Any] = field(default_factory=dict)
    """Of the config: the same for every contender."""
    refine_share: float = 1.0
    """Of a preset's refining steps: small pictures converge sooner."""

    def to_json(self) -> dict[str, Any]:
        """As plain values."""
        return asdict(self)


def scene_at(path: Path) -> BenchmarkScene:
    """A recording or a synthetic dive that the user names.

    Raises:
        InputError: nothing is there.
    """
    if not path.exists():
        raise InputError(f"there is no scene at {path}; give a recording or a synthetic dive")
    if (path / SYNTHETIC_MARK).is_file():
        return BenchmarkScene(path.name, str(path), truth=str(path), clean=str(path))
    folder = path if path.is_dir() else path.parent
    calibration, truth = folder / "camera.yaml", truth_in(folder)
    return BenchmarkScene(
        path.stem,
        str(path),
        None if truth is None else str(truth),
        str(calibration) if calibration.is_file() else None,
    )


def truth_in(folder: Path) -> Path | None:
    """The folder's only trajectory, or else its only table of positions."""
    for pattern in ("poses*.tum", "*.tum", "positions*.csv"):
        found = sorted(folder.glob(pattern))
        if len(found) == 1:
            return found[0]
    return None
