"""Clocks that stand, run backwards or jump: the poses do not care, the files stay in order."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from aquaflow.config import Config
from aquaflow.dive.folder import DiveFolder
from aquaflow.lab.stress.case import Check, case
from aquaflow.lab.stress.swim import Tracking, clear_swim, clear_tracking, sound, track

HOUR_NS = 3_600_000_000_000
"""Nanoseconds of an hour."""


def _check_clock(check: Check, seed: int, time_ns: Callable[[int], int]) -> None:
    frames = [replace(f, t_ns=time_ns(f.index)) for f in clear_swim(seed)]
    result = track(frames)
    sound(check, frames, result)
    same = clear_tracking(seed).posed
    check.true("the same frames are posed", set(same) == set(result.posed))
    for i in set(same) & set(result.posed):
        T, wanted = result.posed[i].T_wc, same[i].T_wc
        assert T is not None
        assert wanted is not None
        check.below("change of a position", float(np.abs(T.t - wanted.t).max()), 1e-12)
    _written_in_order(check, result)


def _written_in_order(check: Check, result: Tracking) -> None:
    posed = list(result.posed.values())
    with tempfile.TemporaryDirectory() as folder:
        dive = DiveFolder(Path(folder) / "dive", Config())
        times = [t.frame.t_ns * 1e-9 for t in posed]
        dive.write_trajectory(times, [t.T_wc for t in posed if t.T_wc is not None])
        dive.close()
        rows = np.loadtxt(dive.path / "trajectory.tum", ndmin=2)
    check.finite("trajectory.tum", rows)
    check.true("every pose is written", len(rows) == len(posed))
    check.true("its times never run backwards", bool((np.diff(rows[:, 0]) >= 0.0).all()))
    length = np.linalg.norm(rows[:, 4:8], axis=1)
    check.below("quaternion length - 1", float(np.abs(length - 1.0).max()), 1e-6)


@case("time", "dive.folder.DiveFolder.write_trajectory")
def duplicate_times(check: Check, seed: int) -> None:
    """Every two frames carry the same time."""
    _check_clock(check, seed, lambda i: i // 2 * 100_000_000)


@case("time", "dive.folder.DiveFolder.write_trajectory")
def reversed_times(check: Check, seed: int) -> None:
    """The clock runs backwards."""
    _check_clock(check, seed, lambda i: (100 - i) * 100_000_000)


@case("time", "dive.folder.DiveFolder.write_trajectory")
def jumping_times(check: Check, seed: int) -> None:
    """The clock is set while the vehicle dives."""
    _check_clock(check, seed, lambda i: i * 100_000_000 + (HOUR_NS if i % 3 == 1 else 0))


@case("time", "dive.folder.DiveFolder.write_trajectory")
def huge_gaps(check: Check, seed: int) -> None:
    """A year between frames."""
    _check_clock(check, seed, lambda i: i * 24 * 365 * HOUR_NS)
