"""The matches of all anchors of a joint adjustment, in bounded memory.

What was measured never changes: the first of it stays in memory, the rest waits in a file without a
name and is read anchor by anchor, whenever the matches are gone through. What an adjustment thinks
of the matches, their noise and which of them it uses, is small and stays in memory.
"""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np

from aquaflow.tracking.adjustment.equations import AnchorMatches, Array, Mask

log = logging.getLogger(__name__)

MATCHES_BYTES = 32 << 20
"""Of measurements that stay in memory; a keyframe of 300 points that six others see has 25 kB."""

Judged: TypeAlias = tuple[Array, Mask]
"""[V] noise of each pair's matches, normalised plane, and [V, P] which of them are used."""
Maker: TypeAlias = Callable[[], AnchorMatches]


class Matches(Protocol):
    """The matches of some anchors, always in the same order."""

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[AnchorMatches]: ...


@dataclass(frozen=True)
class MadeMatches:
    """Matches that are made whenever they are gone through, and not kept."""

    makers: Sequence[Maker]
    """Of each anchor."""

    def __len__(self) -> int:
        return len(self.makers)

    def __iter__(self) -> Iterator[AnchorMatches]:
        return (make() for make in self.makers)


@dataclass(frozen=True)
class StoredMatches:
    """Measurements that stay, and what is thought of them now."""

    measured: MadeMatches
    judged: Sequence[Judged]
    """Of each anchor."""

    @staticmethod
    def of(matches: Iterable[AnchorMatches], folder: Path | None) -> StoredMatches:
        """Keep ``matches``, those beyond MATCHES_BYTES in a file of ``folder`` if there is one and
        the disk has room."""
        makers, judged, room = list[Maker](), list[Judged](), MATCHES_BYTES
        file = None if folder is None else _MatchesFile(folder)
        for each in matches:
            judged.append((each.sigma, each.used))
            room -= sum(getattr(each, name).nbytes for name in MEASURED)
            kept = None if file is None or room >= 0 else file.keep(each)
            makers.append(kept or partial(replace, each))
        return StoredMatches(MadeMatches(makers), judged)

    def judged_as(
        self,
        judged: Iterable[Judged],  # of each anchor [V] and [V, P]
    ) -> StoredMatches:
        """The same measurements, and what is thought of them after another look."""
        return replace(self, judged=list(judged))

    def __len__(self) -> int:
        return len(self.judged)

    def __iter__(self) -> Iterator[AnchorMatches]:
        pairs = zip(self.measured, self.judged, strict=True)
        return (replace(each, sigma=sigma, used=used) for each, (sigma, used) in pairs)


# --------------------------------------------------------------------------------------------------
# Measurements in a file, which ends with the last that knows of them.

MEASURED = ("rays", "rho", "variance", "at")
"""Columns of an anchor's matches that never change; the one that may be in single precision last:
in the file each begins at a multiple of its item's size."""
NOTHING = np.zeros(0)


class _MatchesFile:
    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._stream: Any = None
        self._end = 0
        self._full = False

    def keep(self, matches: AnchorMatches) -> Maker | None:
        """What reads these again; None where the disk takes no more."""
        columns = [np.ascontiguousarray(getattr(matches, name)) for name in MEASURED]
        begin, size = self._end, sum(column.nbytes for column in columns)
        if self._full or not self._append(b"".join(column.tobytes() for column in columns)):
            return None
        self._end += size
        layout = [(column.dtype, column.shape) for column in columns]
        rest = replace(matches, rays=NOTHING, rho=NOTHING, variance=NOTHING, at=NOTHING)
        return partial(self._read, rest, begin, size, layout)

    def _append(self, content: bytes) -> bool:
        try:
            if self._stream is None:
                self._folder.mkdir(parents=True, exist_ok=True)
                self._stream = tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115
            self._stream.write(content)
            self._stream.flush()
        except OSError as error:
            self._full = True
            log.warning(
                "cannot write to %s (%s): a joint adjustment of many keyframes takes more memory; "
                "give it a folder with room",
                self._folder,
                error.strerror or error,
            )
            return False
        return True

    def _read(
        self,
        rest: AnchorMatches,
        begin: int,
        size: int,
        layout: Sequence[tuple[np.dtype[Any], tuple[int, ...]]],
    ) -> AnchorMatches:
        content, at = os.pread(self._stream.fileno(), size, begin), 0
        columns: dict[str, Any] = {}
        for name, (kind, shape) in zip(MEASURED, layout, strict=True):
            count = int(np.prod(shape))
            columns[name] = np.frombuffer(content, kind, count, at).reshape(shape)
            at += columns[name].nbytes
        return replace(rest, **columns)
