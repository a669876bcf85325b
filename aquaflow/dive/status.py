"""dive.json: how a live dive stands, for the process that comes next."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import Enum
from pathlib import Path

from aquaflow.base.errors.regular_file import read_regular_json
from aquaflow.base.storage.atomic import write_json
from aquaflow.config.device import MountingConfig

NAME = "dive.json"


class DiveState(str, Enum):
    """What became of a dive."""

    OPEN = "open"
    """It is being mapped, or was when its process was killed."""
    FINISHING = "finishing"
    """The pilot wants it finished; a process that ends now has left that undone."""
    STOPPED = "stopped"
    """The service was told to end: the deliverables are there, and the dive may go on."""
    FINISHED = "finished"
    """Nothing comes any more."""

    @property
    def is_complete(self) -> bool:
        """True if the deliverables hold everything."""
        return self in (DiveState.STOPPED, DiveState.FINISHED)


@dataclass(frozen=True)
class DiveStatus:
    """The content of dive.json."""

    state: DiveState
    paused: bool
    """The pilot wants nothing mapped, until he asks for it."""
    begun_utc: str | None
    """By the computer's clock; None while that had never been set."""
    boot: str
    """Of the kernel under which the dive last ran; its monotonic clock counts from there."""
    mounting: dict[str, object] | None
    """Of the camera in the body, as the config or the camera stated it."""

    def write(self, dive: Path) -> None:
        """Raises InputError if it cannot be written."""
        write_json(dive / NAME, asdict(self))

    def stated_mounting(self) -> MountingConfig | None:
        """The mounting again; None where none was stated."""
        return None if self.mounting is None else MountingConfig.model_validate(self.mounting)


def read_status(dive: Path) -> DiveStatus | None:
    """How the dive in this folder stands; None where nothing readable says so."""
    try:
        found = read_regular_json(dive / NAME)
        begun, boot, mounting = (found[name] for name in ("begun_utc", "boot", "mounting"))
        paused = found["paused"] is True
        status = DiveStatus(DiveState(found["state"]), paused, begun, boot, mounting)
        status.stated_mounting()
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    if not isinstance(begun, str | None) or not isinstance(boot, str):
        return None
    return status
