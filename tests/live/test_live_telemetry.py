"""A live dive uses its telemetry as a replay does, keeps it, and has it again when it goes on."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from aquaflow.config import Config
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.dive.folder import DiveFolder
from aquaflow.dive.replay import map_recording
from aquaflow.geometry.alignment import align
from aquaflow.lab.evaluation.trajectory_error import read_tum
from aquaflow.live.checkpoint.generations import SetAside
from aquaflow.live.checkpoint.repair import cut_at_checkpoint
from aquaflow.live.checkpoint.resume import resume_folder
from aquaflow.live.clock_reading import ClockReading
from aquaflow.live.live_dive import LiveDive
from aquaflow.recordings.playback import Event, Playback
from aquaflow.recordings.telemetry_lines import TelemetryLines, TelemetryWriter
from aquaflow.sources import mounting_of, open_recording
from aquaflow.sources.telemetry_input import TelemetryInput, open_telemetry
from aquaflow.telemetry.metric_file import read_metric_file
from aquaflow.types import Altitude, Depth, Dropped, Frame, Position, UtcTime, Velocity
from tests.live.live_scenes import VEHICLE, ToldFeed, caught_up
from tests.small_recording import FRAMES

SETTINGS = {"threads": 1, "mapping": {"enabled": False}}
ASKED = VEHICLE.model_dump(include={"service"}) | SETTINGS
UTC_NS = 1_795_365_000_000_000_000
CUT = 14
"""Frames before the cut."""


class Fixes:
    """UTC and a position of GNSS once a second, as the recording has none."""

    notes: list[str] = []  # noqa: RUF012

    def samples(self) -> Iterator[UtcTime | Position]:
        for second in range(3):
            t_ns = second * 1_000_000_000
            yield UtcTime(t_ns, t_ns, "gnss", UTC_NS + t_ns)
            for fifth in range(5):
                at_ns = t_ns + fifth * 200_000_000
                yield Position(at_ns, at_ns, "gnss", 63.43, 10.39, 2.0)

    def close(self) -> None: ...


def telemetry_of(recording: Path) -> TelemetryInput:
    known = open_telemetry(recording)
    return replace(known, synchronised=[*known.synchronised, Fixes()])


def begun(recording: Path, folder: Path) -> tuple[LiveDive, ToldFeed, Iterator[Event]]:
    source, feed = open_recording(recording), ToldFeed()
    feed.calibration, feed.mounting = source.camera, mounting_of(source)
    dive = LiveDive("live", resume_folder(folder, False), feed, VehicleConfig.model_validate(ASKED))
    return dive, feed, Playback(source, telemetry_of(recording).synchronised).events()


def played(dive: LiveDive, feed: ToldFeed, events: Iterator[Event]) -> None:
    """Turn by turn; no thread but the keyframe graph's decides when anything happens."""
    for event in events:
        if isinstance(event, (Frame, Dropped)):
            dive.parts.loop.take(event)
        else:
            feed.latest_samples.take(event)
    caught_up(dive)


@dataclass
class Both:
    live: Path
    replayed: Path


@pytest.fixture(scope="module")
def both(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Both:
    root = tmp_path_factory.mktemp("both")
    map_recording(
        open_recording(small_recording), "replay", root / "replay",
        Config.model_validate(SETTINGS), telemetry=telemetry_of(small_recording),
    )  # fmt: skip
    dive, feed, events = begun(small_recording, root / "live")
    played(dive, feed, events)
    dive.parts.loop.end()
    dive.parts.run.finish([])
    dive.close()
    return Both(root / "live", root / "replay")


def table(dive: Path) -> list[dict[str, str]]:
    with (dive / "trajectory.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_live_and_replay_give_the_same_scale_and_gravity(both: Both) -> None:
    live, replayed = read_metric_file(both.live)[0], read_metric_file(both.replayed)[0]
    path, path_r = (read_tum(dive / "trajectory.tum") for dive in (both.live, both.replayed))
    assert live.metric
    assert live.level
    # The two maps differ: a live one waits for nothing. Their scales differ less than their shapes.
    p, p_r = (
        live.T_nm.inverse().apply(path.positions),
        replayed.T_nm.inverse().apply(path_r.positions),
    )
    T = align(p, p_r, with_scale=True).T_target_source
    difference = np.linalg.norm(T.apply(p) - p_r) / np.linalg.norm(p_r - p_r.mean(axis=0))
    assert difference < 0.01
    assert replayed.T_nm.scale * T.scale == pytest.approx(live.T_nm.scale, rel=difference)
    extent_m = np.ptp(path_r.positions, axis=0).max()
    np.testing.assert_allclose(path.positions, path_r.positions, atol=0.01 * extent_m)
    # Down in each camera: both dives heard the same attitudes, whose errors are in both.
    cosine = (path.R_wc[:, 2] * path_r.R_wc[:, 2]).sum(axis=1).clip(-1.0, 1.0)
    assert np.arccos(cosine).max() < 0.5 * live.tilt_sigma_rad
    assert live.scale_sigma == pytest.approx(replayed.scale_sigma, rel=0.2)
    assert [s.source for s in live.sources] == [s.source for s in replayed.sources]


def test_what_the_vehicle_measured_is_in_the_table_of_a_live_dive(both: Both) -> None:
    rows = table(both.live)
    assert len(rows) == FRAMES
    for name in ("depth_m", "altitude_m", "heading_deg", "roll_deg", "speed_m_s", "latitude_deg"):
        assert all(row[name] for row in rows), name
    assert [row["depth_m"] for row in rows] == [row["depth_m"] for row in table(both.replayed)]
    assert rows[0]["utc"].startswith("2026-11-22T")
    assert (both.live / "georeference.json").exists()


def test_a_live_dive_keeps_its_telemetry_and_a_replay_does_not_repeat_it(
    both: Both, small_recording: Path
) -> None:
    heard = [
        event
        for event in Playback(None, telemetry_of(small_recording).synchronised).events()
        if not isinstance(event, (Frame, Dropped))
    ]
    kept = list(TelemetryLines(both.live / "telemetry.jsonl").samples())
    assert kept == heard[: len(kept)]
    assert {type(sample) for sample in kept} >= {Depth, Altitude, Velocity, Position, UtcTime}
    assert not (both.replayed / "telemetry.jsonl").exists()


def test_a_resumed_dive_has_its_telemetry_and_its_metric_frame_at_once(
    small_recording: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "dive"
    dive, feed, events = begun(small_recording, folder)
    until = []
    for event in events:
        until.append(event)
        if isinstance(event, Frame) and event.index == CUT:
            break
    played(dive, feed, iter(until))
    dive.parts.checkpointer.take()
    caught_up(dive)
    before = dive.parts.slam.metric.telemetry  # the process ends here: nothing is closed
    dive.folder._lock.release()
    with (folder / "telemetry.jsonl").open("ab") as stream:
        stream.write(b'{"kind":"depth","t_ns":12')

    back, feed, _ = begun(small_recording, folder)
    metric = back.parts.slam.metric
    for kind in (Depth, Altitude, Velocity):
        [was], [now] = before.of(kind), metric.telemetry.of(kind)
        np.testing.assert_array_equal(now.t_s, was.t_s)
        np.testing.assert_array_equal(now.values, was.values)
    assert metric.telemetry.utc == before.utc
    known = back.parts.slam.metric_frame(0)
    assert known.metric
    assert any("1 damaged" in note for note in back.parts.run.notes)
    assert len(metric._points) == len(back.parts.slam.keyframes)
    played(back, feed, events)
    back.parts.loop.end()
    finished = back.parts.run.finish([])
    assert finished.metrics["unit"] == "m"
    assert read_metric_file(folder)[0].T_nm.scale == pytest.approx(known.T_nm.scale, rel=0.03)
    assert [row["index"] for row in table(folder) if not row["depth_m"]] == []
    dive.close()
    back.close()


@pytest.mark.parametrize(("boot", "left"), [("same", 5), ("other", 3)])
def test_after_another_boot_telemetry_ends_where_the_checkpoint_was_taken(
    tmp_path: Path, boot: str, left: int
) -> None:
    path = tmp_path / "telemetry.jsonl"
    log = TelemetryWriter(path)
    log.add([Depth(t_ns, t_ns, "d", 1.0) for t_ns in (10, 20, 30, 40, 50)])
    log.close()
    taken, now = ClockReading(25, 0, "same", dive_shift_ns=7), ClockReading(60, 0, boot)
    cut_at_checkpoint(tmp_path, taken, now, SetAside(tmp_path))
    assert len(list(TelemetryLines(path).samples())) == left
    aside = tmp_path / "set-aside-1" / "telemetry.jsonl"
    assert aside.exists() is (boot == "other")
    cut_at_checkpoint(tmp_path, taken, now, SetAside(tmp_path))
    assert not (tmp_path / "set-aside-2").exists()


def test_a_new_dive_in_the_same_folder_begins_without_the_old_telemetry(tmp_path: Path) -> None:
    folder = DiveFolder(tmp_path, Config())
    log = TelemetryWriter(tmp_path / "telemetry.jsonl")
    log.add([Depth(1, 1, "d", 1.0)])
    log.close()
    folder.close()
    DiveFolder(tmp_path, Config(), resume=folder.rows).close()
    assert (tmp_path / "telemetry.jsonl").exists()
    DiveFolder(tmp_path, Config(), overwrite=True).close()
    assert not (tmp_path / "telemetry.jsonl").exists()


def test_a_dive_without_telemetry_so_far_has_none_to_cut(tmp_path: Path) -> None:
    cut_at_checkpoint(
        tmp_path, ClockReading(1, 0, "a"), ClockReading(1, 0, "b"), SetAside(tmp_path)
    )
    assert list(tmp_path.iterdir()) == []
