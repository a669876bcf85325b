"""Checkpoints: the state that survives a kill or a power cut, from which the next start resumes.

A checkpoint's size is that of the map and a row for every frame; the last two are kept (see
generations.py). Pictures and depths lie in ``work/``, one file for each keyframe and view, and are
on the disk before a checkpoint that names them is.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from aquaflow import __version__
from aquaflow.base.clocks.device import Learned
from aquaflow.base.errors import InputError
from aquaflow.dive.run import DiveRun
from aquaflow.geometry.arrays import Arrays, add_prefix, of_sim3, to_sim3, under
from aquaflow.live.checkpoint import tracking
from aquaflow.live.checkpoint.generations import (
    FORMAT,
    Checkpoint,
    bring_to_disk,
    state_file,
    write_state,
)
from aquaflow.live.clock_reading import ClockReading
from aquaflow.live.map_thread import MapCorrection, MapThread
from aquaflow.mapping.work import MapWork, OwnedMaps
from aquaflow.recordings.telemetry_lines import NAME as TELEMETRY
from aquaflow.slam import Slam
from aquaflow.tracking.graph.keyframe_graph import LOOP_SEARCH

log = logging.getLogger(__name__)


class UnusableStateError(InputError):
    """A readable checkpoint that this program cannot resume from."""


class Checkpointer:
    """Takes checkpoints: tracking's part in the loop, the map's part and the writing in its
    thread."""

    def __init__(
        self,
        dive: Path,
        run: DiveRun,
        slam: Slam,
        maps: MapThread,
        every_s: float,
        clocks: Callable[[], Mapping[str, Learned]],
        shift_ns: Callable[[], int] = lambda: 0,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """``shift_ns``: from this boot's clock to the dive's."""
        self.taken = 0
        self.failures = 0
        self.size_bytes = 0
        self.wrote_s = 0.0
        """Duration of the last write."""
        self._dive, self._run, self._slam, self._maps = dive, run, slam, maps
        self._every_s, self._clocks, self._now_s = every_s, clocks, now_s
        self._shift_ns = shift_ns
        self._due_s = now_s() + every_s
        self._writing = False

    def take_if_due(self, disk_is_full: bool) -> None:
        """Take a checkpoint if it is time, the last one is done, there is room, and no loops are
        looked for."""
        if self._now_s() < self._due_s or self._writing or disk_is_full:
            return
        self._slam.take_finished()
        if self._slam.worker.waiting(LOOP_SEARCH):
            return
        self._due_s = self._now_s() + self._every_s
        self.take()

    def take_soon(self) -> None:
        """Take one at the next turn."""
        self._due_s = self._now_s()

    def take(self) -> None:
        """Take a checkpoint now; requests that wait in the mapping thread are not in it, except
        corrections. A search of loops is waited for: a dive that goes on does not make it again."""
        if self._slam.worker.waiting(LOOP_SEARCH):
            self._slam.take_finished(wait=True)
        with self._run.profiler.stage("checkpoint"):
            parts = tracking.serialise(self._slam, self._run)
            if parts is None:
                return
            facts, arrays = parts
            try:
                files = self._slam.keyframes.save()
            except OSError as error:  # what it would name is not there
                self._record_failure(error)
                return
        moment = replace(ClockReading.now(), dive_shift_ns=self._shift_ns())
        head = {"format": FORMAT, "version": __version__, "moment": moment.to_json()}
        head |= {"tracking": facts, "clocks": self._clocks()}
        arrays = add_prefix("tracking", arrays)

        def write(maps: OwnedMaps, lacking: list[MapCorrection]) -> None:
            self._write(maps, lacking, head, arrays, files)

        self._writing = True
        self._maps.inspect("write a checkpoint", write)

    def _write(
        self,
        maps: OwnedMaps,
        lacking: list[MapCorrection],
        head: dict[str, Any],
        arrays: Arrays,  # of the tracking
        files: list[Path],
    ) -> None:
        """In the mapping thread."""
        began = time.monotonic()
        try:
            facts, own = maps.serialise()
            facts["lacking"], more = serialise_corrections(lacking)
            own |= more
            bring_to_disk([*files, self._dive / TELEMETRY, *maps.save_pictures()])
            write_state(self._dive, head | {"mapping": facts}, arrays | add_prefix("mapping", own))
            self.taken += 1
            self.size_bytes = state_file(self._dive).stat().st_size
        except (InputError, OSError) as error:
            self._record_failure(error)
        finally:
            self.wrote_s = time.monotonic() - began
            self._writing = False

    def _record_failure(self, error: Exception) -> None:
        """Count a failed write; the previous checkpoint stays usable."""
        self.failures += 1
        log.warning("no checkpoint: %s", error)


def restore(checkpoint: Checkpoint, slam: Slam, run: DiveRun, maps: OwnedMaps) -> None:
    """Restore new ``slam``, ``run`` and ``maps`` from ``checkpoint``.

    Raises:
        ConfigError: the config asks for pictures of another size.
        UnusableStateError: it does not fit.
    """
    facts, arrays = checkpoint.facts, checkpoint.arrays
    try:
        tracking.deserialise(slam, run, facts["tracking"], under("tracking", arrays))
        maps.restore(facts["mapping"], under("mapping", arrays))
        catch_up(maps, facts["mapping"]["lacking"], under("mapping", arrays))
    except (KeyError, ValueError, TypeError, IndexError, RuntimeError, InputError) as error:
        raise UnusableStateError(f"{checkpoint.file} cannot be used: {error}") from error


# --------------------------------------------------------------------------------------------------
# Corrections that the maps of a checkpoint do not contain yet.


def serialise_corrections(lacking: Sequence[MapCorrection]) -> tuple[list[dict[str, Any]], Arrays]:
    """Corrections that the maps do not contain yet: facts for JSON, and arrays."""
    facts: list[dict[str, Any]] = []
    arrays: Arrays = {}
    for i, correction in enumerate(lacking):
        merged = {str(source): target for source, target in correction.merged.items()}
        facts.append({"merged": merged})
        arrays[f"lacking{i}.keyframes"] = np.array(list(correction.moves), np.int64)
        arrays[f"lacking{i}.moves"] = of_sim3(list(correction.moves.values()))
    return facts, arrays


def catch_up(
    maps: MapWork,
    lacking: list[dict[str, Any]],
    arrays: Arrays,  # as from serialise_corrections
) -> None:
    """Apply the corrections of :func:`serialise_corrections` to the maps."""
    for i, facts in enumerate(lacking):
        numbers, moves = arrays[f"lacking{i}.keyframes"], arrays[f"lacking{i}.moves"]
        by_keyframe = {int(n): to_sim3(row) for n, row in zip(numbers, moves, strict=True)}
        merged = {int(source): int(target) for source, target in facts["merged"].items()}
        maps.correct(by_keyframe, merged)
