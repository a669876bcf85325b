"""Opens an earlier dive as the base of another."""

from __future__ import annotations

from pathlib import Path

from aquaflow.base.errors import InputError
from aquaflow.base.errors.regular_file import read_regular_json
from aquaflow.base.storage.dive_status import refuse_unfinished
from aquaflow.keyframes.places_file import NAME, PlacesFile
from aquaflow.telemetry.metric_file import read_metric_file
from aquaflow.tracking.base.base import Base

METRICS = "metrics.json"
"""Says which prior the dive was tracked with."""


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
