"""How long ago a dive was cut off: by a clock that ran on, or by one that was set since.

The wall clock of a board without a battery goes on where it stood when the machine was switched
off, until a time server is heard: by such a clock yesterday's dive ended a minute ago.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from aquaflow.base.clocks.computer import clock_is_set
from aquaflow.base.storage.dive_status import CHECKPOINT
from aquaflow.dive.folder import MARKER
from aquaflow.live.moment import Moment
from aquaflow.recordings.telemetry_lines import NAME as TELEMETRY

NS_PER_H = 3.6e12
WRITTEN = (MARKER, TELEMETRY, f"{CHECKPOINT}/*.npz")
"""Files that a dive writes all the time."""


@dataclass(frozen=True)
class Age:
    """Hours since a dive's last sign of life; None where no clock tells."""

    hours: float | None
    unknown: str = ""
    """Why it is not known, as a clause."""


def age_of(
    dive: Path, taken: Moment, now: Moment, is_set: Callable[[], bool] = clock_is_set
) -> Age:
    """The age of ``dive``, whose newest checkpoint was ``taken`` then.

    Within one boot the monotonic clock tells. After another one the wall clock does, from the
    newest time that the dive's files bear, if it ``is_set`` and not behind that time.
    """
    if taken.is_of_the_boot_of(now):
        return Age((now.monotonic_ns - taken.monotonic_ns) / NS_PER_H)
    newest_ns = max([taken.wall_ns, *_written_ns(dive)])
    if now.wall_ns < newest_ns:
        return Age(None, "the computer's clock is behind the dive's files")
    if not is_set():
        return Age(None, "nothing has set the computer's clock since it was started")
    return Age((now.wall_ns - newest_ns) / NS_PER_H)


def _written_ns(dive: Path) -> list[int]:
    found = (path for name in WRITTEN for path in dive.glob(name))
    return [path.stat().st_mtime_ns for path in found]
