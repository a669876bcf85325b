"""Failures that cost one frame or one stage, never the dive.

OpenCV, SciPy, torch, ONNX Runtime and the file system may raise at any frame of any dive. Every
stage runs inside :meth:`Failures.contain`: what it raises is counted by kind, its traceback goes to
the log once, and the dive goes on without the result of that stage.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

from aquaflow.base.errors import (
    ConfigError,
    NotMappedError,
    first_line,
    is_device_failure,
    is_device_full,
    is_full_disk,
    is_out_of_memory,
    times,
)

log = logging.getLogger(__name__)

STRICT = "AQUAFLOW_STRICT"
"""Environment variable; where it is 1, nothing is contained, so that tests see every defect."""

REPEATED = 3
"""Failures of one stage within ``RECENT_S`` that make the service's state "degraded"; a single one
is an odd picture, and is in the counts."""
RECENT_S = 60.0
"""After so long without a failure a stage counts as working again."""
REASONS_KEPT = 256
"""Frames whose failure is remembered until their row is written: more than ever wait for a pose."""

DEFECTS = (
    AssertionError, AttributeError, LookupError, NameError, NotImplementedError, TypeError,
)  # fmt: skip
"""Raised by our own code, these are programming errors of ours, whatever the picture shows."""

ATTEMPTS = 2
"""Of a step at a dive's end: what made it fail may have passed, and nothing waits for it."""

OWN_PACKAGE = "aquaflow"
ROOT = Path(__file__).resolve().parents[3]
"""Our package, and the folder that holds it; code elsewhere is another library's."""


T = TypeVar("T")


@dataclass
class Kind:
    """Failures of one stage with the same exception from the same function."""

    stage: str
    error: str
    """Class of the exception, with its module if it is not Python's own."""
    place: str
    """File and function of ours that it came through last."""
    message: str
    """First line of the first one's text."""
    defect: bool
    """True for a programming error of ours."""
    first_frame: int | None = None
    """Index in the recording; None outside of a frame."""
    count: int = 0

    def to_json(self) -> dict[str, Any]:
        """The failure as metrics.json and /health have it."""
        return {
            "stage": self.stage,
            "error": self.error,
            "place": self.place,
            "defect": self.defect,
            "count": self.count,
            "first_frame": self.first_frame,
        }

    def note(self) -> str:
        """One line for the user."""
        at = "" if self.first_frame is None else f", first at frame {self.first_frame}"
        ours = "; a defect in AquaFlow, please report it with log.jsonl" if self.defect else ""
        return f"{self.stage} failed {times(self.count)}{at} ({self.error} in {self.place}){ours}"


class Failures:
    """Counts of what failed in one dive; any thread may use it."""

    def __init__(
        self, strict: bool | None = None, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        """``strict`` lets every exception through; None: as the environment says."""
        self.strict = os.environ.get(STRICT) == "1" if strict is None else strict
        self.disk_was_full = False
        """A file of the dive found no room."""
        self.of_device = 0
        """Failures so far that were the GPU's."""
        self.device_full = 0
        """Those of them for want of memory."""
        self._kinds: dict[tuple[str, str, str], Kind] = {}
        self._recent: deque[tuple[float, str]] = deque(maxlen=100)
        """When which stage failed."""
        self._reasons: OrderedDict[int, str] = OrderedDict()
        self._now_s, self._lock = now_s, threading.Lock()

    def contain(self, stage: str, frame: int | None = None, full_disk: bool = False) -> Contained:
        """A ``with`` block whose exceptions are counted here and go no further.

        Let through are KeyboardInterrupt and SystemExit, full memory, a full disk, bad settings,
        and a dive of which nothing can be mapped: each has its own way to the user. With
        ``full_disk``, one is counted too, and ``disk_was_full`` set: smaller files may find room.
        """
        return Contained(self, stage, frame, full_disk)

    def attempt(self, stage: str, work: Callable[[], T]) -> T | None:
        """Contain ``work``, and do it once more if it failed; None if it failed again.

        A full disk is counted, and has no second attempt.
        """
        for _ in range(ATTEMPTS):
            with self.contain(stage, full_disk=True) as run:
                return work()
            if run.error is not None and is_full_disk(run.error):
                break
        return None

    def record(self, stage: str, error: Exception, frame: int | None = None) -> None:
        """Count ``error``; the first of its kind is logged with its traceback."""
        name, (place, innermost) = _name_of(error), _place_of(error)
        with self._lock:
            kind = self._kinds.get((stage, name, place))
            is_new = kind is None
            if kind is None:
                defect = innermost and isinstance(error, DEFECTS)
                kind = Kind(stage, name, place, first_line(error), defect, frame)
                self._kinds[stage, name, place] = kind
            kind.count += 1
            self.of_device += is_device_failure(error)
            self.device_full += is_device_full(error)
            self._recent.append((self._now_s(), stage))
            if frame is not None:
                self._reasons[frame] = f"{stage} failed: {name} in {place}"
                while len(self._reasons) > REASONS_KEPT:
                    self._reasons.popitem(last=False)
        if is_new:
            fields = {"event": "failure", **kind.to_json()}
            log.error("%s: %s", kind.note(), kind.message, exc_info=error, extra={"fields": fields})

    @property
    def kinds(self) -> list[Kind]:
        """Every kind so far, in the order of their first failure."""
        with self._lock:
            return list(self._kinds.values())

    @property
    def total(self) -> int:
        """Failures of all kinds."""
        return sum(kind.count for kind in self.kinds)

    def reason(self, frame: int) -> str | None:
        """Why a frame has no pose, if a stage failed on it; asked for once."""
        with self._lock:
            return self._reasons.pop(frame, None)

    def list_repeated(self) -> list[str]:
        """Stages that failed again and again within the last minute, in words."""
        since = self._now_s() - RECENT_S
        with self._lock:
            stages = [stage for t_s, stage in self._recent if t_s >= since]
        return [
            f"{stage} failed {stages.count(stage)} times within {RECENT_S:.0f} s"
            for stage in dict.fromkeys(stages)
            if stages.count(stage) >= REPEATED
        ]

    def notes(self) -> list[str]:
        """A line for each kind that is no programming error of ours."""
        return [kind.note() for kind in self.kinds if not kind.defect]

    def defects(self) -> list[str]:
        """A line for each that is one: what its stage would have found is missing from every dive
        like this one."""
        return [kind.note() for kind in self.kinds if kind.defect]

    def to_json(self) -> list[dict[str, Any]]:
        """The failures as metrics.json has them: an object for each kind."""
        return [kind.to_json() for kind in self.kinds]


class Contained:
    """One run of a stage; ``failed`` is True afterwards if it raised."""

    __slots__ = ("_failures", "_frame", "_full_disk", "_stage", "error")

    def __init__(self, failures: Failures, stage: str, frame: int | None, full_disk: bool) -> None:
        self._failures, self._stage, self._frame = failures, stage, frame
        self._full_disk = full_disk
        self.error: Exception | None = None

    @property
    def failed(self) -> bool:
        """True if the block raised something that was contained."""
        return self.error is not None

    def __enter__(self) -> Contained:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> bool:
        if not isinstance(error, Exception):
            return False
        is_full = self._full_disk and is_full_disk(error)
        self._failures.disk_was_full |= is_full
        if not is_full and (self._failures.strict or has_own_way(error)):
            return False
        self.error = error
        self._failures.record(self._stage, error, self._frame)
        return True


def has_own_way(error: BaseException) -> bool:
    """True for full memory, a full disk, bad settings, and a dive that cannot be mapped."""
    settled = isinstance(error, ConfigError | NotMappedError)
    return settled or is_out_of_memory(error) or is_full_disk(error)


def _name_of(error: Exception) -> str:
    module = type(error).__module__
    name = type(error).__qualname__
    return name if module == "builtins" else f"{module}.{name}"


def _place_of(error: Exception) -> tuple[str, bool]:
    """The last of our functions in the traceback, and whether no other library's comes after."""
    place, innermost, step = "unknown", False, error.__traceback__
    while step is not None:
        code = step.tb_frame.f_code
        path = Path(code.co_filename)
        innermost = path.is_relative_to(ROOT) and path.relative_to(ROOT).parts[0] == OWN_PACKAGE
        if innermost:
            place = f"{path.relative_to(ROOT).as_posix()}: {code.co_name}"
        step = step.tb_next
    return place, innermost
