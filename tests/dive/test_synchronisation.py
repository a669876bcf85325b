"""Telemetry beside a recording: opened, put on its clock, and used or refused in a sentence."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.base.errors import ArgumentError
from aquaflow.base.errors.crash_report import MISUSED
from aquaflow.base.errors.failures import Failures
from aquaflow.dive.replay import synchronise, turns_of
from aquaflow.dive.run import DiveRun
from aquaflow.geometry.similarity import Sim3
from aquaflow.recordings.images import SUBFOLDER
from aquaflow.sources import RecordedTelemetry
from aquaflow.sources.telemetry_input import TelemetryInput, open_telemetry
from aquaflow.types import AngularRate, Depth, TelemetrySample
from tests.command_line import Cli, refused
from tests.small_recording import HASTY
from tests.telemetry.turning import random_rates

OFFSET_S = 4.25
SECONDS, STEP_S = 30.0, 0.05


def moved_camera() -> tuple[list[Any], list[TelemetrySample]]:
    """Results of two sub-maps, with one frame lost between them, and the gyro's log."""
    rng = np.random.default_rng(0)
    t = np.arange(0.0, SECONDS, STEP_S)
    rate = random_rates(rng, t)
    T_wc = Sim3.identity()
    results = []
    for k, at in enumerate(t):
        first = k < len(t) // 2
        posed = None if k == len(t) // 2 else T_wc
        frame = SimpleNamespace(t_ns=round(at * 1e9))
        results.append(SimpleNamespace(frame=frame, T_wc=posed, sub_map=0 if first else 1))
        turn = Rotation.from_rotvec(STEP_S * 0.5 * (rate[k] + rate[min(k + 1, len(t) - 1)]))
        T_wc = T_wc @ Sim3(turn.as_matrix(), np.zeros(3), 1.0)
    stamps = [round((at - OFFSET_S) * 1e9) for at in t]
    samples: list[TelemetrySample] = [
        AngularRate(ns, ns, "imu", (float(w[0]), float(w[1]), float(w[2])))
        for ns, w in zip(stamps, rate, strict=True)
    ]
    return results, [Depth(stamps[0], stamps[0], "cell", 3.0), *samples]


class Log:
    """A log in memory."""

    specificity = 1
    notes: tuple[str, ...] = ()

    def __init__(self, samples: list[TelemetrySample]) -> None:
        self._samples = samples

    def samples(self) -> list[TelemetrySample]:
        return self._samples


class Run:
    """What :func:`synchronise` needs of a dive."""

    def __init__(self, results: list[Any]) -> None:
        self.results, self.notes = results, list[str]()
        self.used: list[TelemetrySample] = []
        self.waiting_finished = 0
        self.slam = SimpleNamespace(
            failures=Failures(),
            metric=SimpleNamespace(mounting=None),
            finish_tracking=lambda: [],
        )

    def decide(self, decided: list[Any]) -> None:
        self.waiting_finished += 1

    def sample(self, sample: TelemetrySample) -> None:
        self.used.append(sample)


def given(**logs: Log) -> TelemetryInput:
    return TelemetryInput(unsynchronised=cast("dict[str, RecordedTelemetry]", logs))


def test_turns_end_where_a_sub_map_ends() -> None:
    results, _ = moved_camera()
    turns = turns_of(cast("Any", results))
    assert len(turns.start_s) == len(results) - 3  # one lost, so two steps; and one between maps
    assert (turns.end_s - turns.start_s).max() == pytest.approx(STEP_S)


def test_the_samples_of_a_log_reach_the_dive_on_its_clock() -> None:
    results, samples = moved_camera()
    run = Run(results)
    found = synchronise(cast("DiveRun", run), given(vehicle=Log(samples)))
    assert found["vehicle"].offset_s == pytest.approx(OFFSET_S, abs=0.01)
    assert len(run.used) == len(samples)
    assert abs(run.used[0].t_ns) < 10**7
    assert "vehicle was synchronised by its rotations: it begins 4.2" in run.notes[0]
    assert run.waiting_finished == 1


def test_a_log_that_cannot_be_synchronised_costs_itself_and_a_note() -> None:
    results, samples = moved_camera()
    run = Run(results)
    found = synchronise(cast("DiveRun", run), given(sonar=Log(samples[:1]), vehicle=Log(samples)))
    assert set(found) == {"vehicle"}
    assert "sonar could not be synchronised" in run.notes[0]
    assert len(run.used) == len(samples)


def test_without_such_a_log_nothing_is_done() -> None:
    run = Run([])
    assert synchronise(cast("DiveRun", run), TelemetryInput()) == {}
    assert run.waiting_finished == 0


# --- what is opened -------------------------------------------------------------------------------


def test_a_synchronised_recording_brings_its_telemetry(small_recording: Path) -> None:
    opened = open_telemetry(small_recording)
    assert len(opened.synchronised) == 1
    assert not opened.unsynchronised
    assert next(iter(opened.synchronised[0].samples())).t_ns >= 0
    opened.close()


def test_a_log_with_an_offset_is_on_the_recordings_clock(small_recording: Path) -> None:
    log = small_recording / "telemetry.csv"
    opened = open_telemetry(small_recording / SUBFOLDER, [log], 100.0)
    assert not opened.unsynchronised
    (source,) = opened.synchronised
    first = next(iter(source.samples()))
    own = next(iter(open_telemetry(small_recording).synchronised[0].samples()))
    assert first.t_ns - own.t_ns == 100 * 10**9


def test_a_log_without_an_offset_is_kept_apart_by_name(small_recording: Path) -> None:
    log = small_recording / "telemetry.csv"
    opened = open_telemetry(small_recording / SUBFOLDER, [log])
    assert list(opened.unsynchronised) == [str(log)]


def test_an_offset_without_a_log_is_refused(small_recording: Path) -> None:
    with pytest.raises(ArgumentError, match=r"--telemetry-offset .* give the log by --telemetry"):
        open_telemetry(small_recording, (), 3.0)


# --- the command ----------------------------------------------------------------------------------


def test_the_command_notes_a_log_that_is_too_short_and_maps_the_dive(
    command: Cli, small_recording: Path, tmp_path: Path
) -> None:
    log = tmp_path / "vehicle.csv"
    log.write_bytes((small_recording / "telemetry.csv").read_bytes())
    pictures = small_recording / SUBFOLDER
    options = ("--calib", small_recording / "camera.yaml", "--tracking-only", *HASTY)
    ran = command("map", pictures, "--telemetry", log, "--out", tmp_path / "dive", *options)
    assert ran.code == 0
    assert f"{log} could not be synchronised with the video: the video's poses cover" in ran.out


def test_a_missing_log_and_one_without_telemetry_are_refused(
    command: Cli, small_recording: Path, tmp_path: Path
) -> None:
    out = ("--out", tmp_path / "dive")
    missing = tmp_path / "none.tlog"
    refused(command("map", small_recording, "--telemetry", missing, *out), missing)
    picture = tmp_path / "a.png"
    picture.write_bytes(b"no telemetry")
    refused(command("map", small_recording, "--telemetry", picture, *out), picture)
    refused(
        command("map", small_recording, "--telemetry-offset", 3, *out), "--telemetry", code=MISUSED
    )
    assert not (tmp_path / "dive").exists()


def test_a_log_beside_a_live_run_is_refused(
    command: Cli, small_recording: Path, tmp_path: Path
) -> None:
    log = small_recording / "telemetry.csv"
    out = ("--out", tmp_path / "dive")
    refused(
        command("map", small_recording, "--realtime", "--telemetry", log, *out),
        "replay.yaml",
        code=MISUSED,
    )
