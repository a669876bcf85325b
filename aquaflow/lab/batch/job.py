"""A job: a dive, with everything that its bytes depend on, or the call of a function; and what came
of it."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from aquaflow import __version__
from aquaflow.config.stage import StageConfig

State = Literal["done", "poor", "failed", "lost", "full"]
"""``poor``: written, with a warning as of exit code 3 of `aquaflow map`. ``failed``: another
attempt would fail as well. ``lost``: its process or machine died, another attempt may succeed.
``full``: the disk was full."""

WRITTEN = ("done", "poor")
"""States in which the dive's folder is there."""


@dataclass(frozen=True)
class BatchJob:
    """A dive to be made; goes to another process or machine as JSON."""

    name: str
    """Of the dive's folder."""
    source: str
    """Path or URL of the recording."""
    size_bytes: int
    """Of the recording."""
    site: str
    """Folder or URL that the dive is written to."""
    cache: str
    """Local folder for recordings and results of object stores."""
    settings: dict[str, Any]
    """The whole configuration."""
    calibration: str | None
    """Content of a camera.yaml; None: the recording's own, or found from it."""
    threads: int
    """Cores that it takes; part of ``settings`` too."""
    memory_mb: int
    """Estimate of its peak, 1e6 bytes."""
    version: str = __version__

    def digest(self) -> str:
        """Digest of what the dive's bytes depend on, but for the machine and AquaFlow's version."""
        known = [self.name, self.size_bytes, self.settings, self.calibration]
        return hashlib.sha256(json.dumps(known, sort_keys=True).encode()).hexdigest()

    def to_json(self) -> dict[str, Any]:
        """The job for :func:`job_of_json` on another machine."""
        return asdict(self)


@dataclass(frozen=True)
class CallJob:
    """A call of a function of AquaFlow in a process of its own; goes to another as JSON."""

    name: str
    """By which the journal knows it."""
    function: str
    """``module:name``; it takes ``arguments``, and what it returns is left."""
    arguments: dict[str, Any]
    """By name; JSON."""
    size_bytes: int
    """As of a recording: the longest is begun first."""
    memory_mb: int
    """Estimate of its peak, 1e6 bytes."""
    threads: int = 1
    """Cores that it takes."""
    version: str = __version__

    def to_json(self) -> dict[str, Any]:
        """The job for :func:`job_of_json` on another machine."""
        return asdict(self)


Job = BatchJob | CallJob


def job_of_json(content: dict[str, Any]) -> Job:
    """The job that ``to_json`` described."""
    return CallJob(**content) if "function" in content else BatchJob(**content)


@dataclass(frozen=True)
class BatchOutcome:
    """What came of one attempt at a job."""

    state: State
    """``done``, ``poor`` (with a warning), ``failed``, ``lost`` or ``full`` (disk)."""
    sentence: str = ""
    """Why, where the state is not ``done``."""
    frames: int | None = None
    tracked: int | None = None
    """All frames, and those with a pose."""
    psnr: float | None = None
    """Of held-out views, dB; null without a map."""
    cpu_s: float | None = None
    """CPU time of all threads."""
    peak_mb: float | None = None
    """Largest resident set of the process, 1e6 bytes."""
    wall_s: float | None = None
    """From start to end, on the machine's clock."""
    node: str = ""
    """Name of the machine."""
    earlier: bool = False
    """The dive was there before; nothing was done."""

    def to_json(self) -> dict[str, Any]:
        """The outcome for :meth:`of_json` on another machine, the journal and the table."""
        return asdict(self)

    @classmethod
    def of_json(cls, content: dict[str, Any]) -> BatchOutcome:
        """The outcome that :meth:`to_json` described."""
        return cls(**content)


# --------------------------------------------------------------------------------------------------
# Settings of a batch: how many dives at once, in how much memory, how often again.


class BatchConfig(StageConfig):
    """How a batch is run (docs/batch.md); nothing here changes a byte of a dive."""

    jobs: int | None = Field(
        None, ge=1, le=4096, description="dives at once; None: as cores and memory allow"
    )
    memory_gb: float | None = Field(
        None, gt=0, le=1e6, description="1e9 bytes for all dives at once; None: what is free"
    )
    retries: int = Field(
        2, ge=0, le=100, description="attempts after the first, for a dive whose process died"
    )
    cluster: str | None = Field(None, min_length=1, description="address of a Ray cluster")
    cache: Path | None = Field(
        None, description="local folder for what comes from and goes to an object store"
    )
