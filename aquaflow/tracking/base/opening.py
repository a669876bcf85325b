"""Opens an earlier dive, or several in one frame, as the base of another dive."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path

from aquaflow.base.errors import InputError
from aquaflow.base.errors.regular_file import read_regular_json
from aquaflow.base.storage.dive_status import refuse_unfinished
from aquaflow.keyframes.places_file import NAME, PlacesFile
from aquaflow.telemetry.metric_file import read_metric_file
from aquaflow.tracking.base.base import Base

METRICS = "metrics.json"
"""Says which prior the dive was tracked with."""
BASES = "aquaflow.bases"
"""Group of entry points: functions that open a folder of several dives, and return None for a
folder of another kind."""


def base_of(folder: Path) -> Base:
    """What an entry point of :data:`BASES` recognises in ``folder``, or the finished dive there.

    Raises:
        InputError: it is neither, or cannot be used.
    """
    for entry in entry_points(group=BASES):
        opened: Callable[[Path], Base | None] = entry.load()
        base = opened(folder)
        if base is not None:
            return base
    return open_base(folder)


def open_base(folder: Path) -> Base:
    """The finished dive in ``folder`` as a base; its keypoints stay in the file until asked for.

    Raises:
        InputError: it is no finished dive, has no places, or they cannot be read.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder; give that of a finished dive to --in")
    refuse_unfinished(folder)
    if not (folder / NAME).is_file():
        raise InputError(
            f"{folder} has no {NAME}, by which places are found again; give a finished dive to "
            "--in, or map it again with this AquaFlow"
        )
    file = PlacesFile(folder / NAME)
    if not file.places:
        raise InputError(f"{folder / NAME} holds no place; give another dive to --in")
    return Base(folder, prior_of(folder), file.places, file.keypoints, read_metric_file(folder))


def prior_of(folder: Path) -> str:
    """The prior of a dive; empty where metrics.json is missing or damaged, which costs only the
    check that both dives have the same."""
    try:
        stated = read_regular_json(folder / METRICS)
        return str(stated.get("prior") or "")
    except (OSError, ValueError, AttributeError):
        return ""
