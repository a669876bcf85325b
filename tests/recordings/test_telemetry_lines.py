"""telemetry.jsonl: samples keep every bit; a damaged line or a full disk costs only itself."""

from __future__ import annotations

from pathlib import Path

import pytest

from aquaflow.recordings import telemetry_lines
from aquaflow.recordings.dive_telemetry import DiveTelemetry
from aquaflow.recordings.telemetry_lines import (
    LONGEST_LINE,
    TelemetryLines,
    TelemetryWriter,
    of_line,
)
from aquaflow.types import (
    Acceleration,
    Altitude,
    AngularRate,
    Attitude,
    Depth,
    Lights,
    Position,
    TelemetrySample,
    UtcTime,
    Velocity,
)

SECOND = 1_000_000_000
STAMP = (5 * SECOND, 5 * SECOND + 7, "rov/x")
THIRD = 1.0 / 3.0
SAMPLES: list[TelemetrySample] = [
    Depth(*STAMP, THIRD),
    Attitude(*STAMP, (0.5, -0.5, THIRD, 1e-17)),
    AngularRate(*STAMP, (THIRD, 0.0, -1e9)),
    Acceleration(*STAMP, (9.81, THIRD, -0.0)),
    Velocity(*STAMP, (1.0, 2.0, THIRD), 0.01),
    Altitude(*STAMP, THIRD),
    Lights(*STAMP, 0.25),
    Position(*STAMP, -41.0 - THIRD, 174.8, THIRD),
    UtcTime(*STAMP, 1_795_365_000_123_456_789),
]


def written(path: Path, samples: list[TelemetrySample]) -> Path:
    log = TelemetryWriter(path)
    log.add(samples)
    log.close()
    return path


def test_samples_of_every_kind_come_back_with_every_bit(tmp_path: Path) -> None:
    path = written(written(tmp_path / "t.jsonl", SAMPLES[:4]), SAMPLES[4:])
    assert list(TelemetryLines(path).samples()) == SAMPLES


def test_samples_are_on_the_disk_before_the_file_is_closed(tmp_path: Path) -> None:
    log = TelemetryWriter(tmp_path / "t.jsonl")
    log.add(SAMPLES)
    assert list(TelemetryLines(log.path).samples()) == SAMPLES
    log.close()


@pytest.mark.parametrize("cut", [1, 20, 60])
def test_a_line_that_was_cut_off_costs_itself(tmp_path: Path, cut: int) -> None:
    path = written(tmp_path / "t.jsonl", SAMPLES[:2])
    path.write_bytes(path.read_bytes()[:-cut])
    expected = SAMPLES[:1] if cut > 1 else SAMPLES[:2]
    assert list(TelemetryLines(path).samples()) == expected
    lines = TelemetryLines(written(path, SAMPLES[2:]))
    assert list(lines.samples()) == expected + SAMPLES[2:]
    assert lines.damaged == (cut > 1)


@pytest.mark.parametrize(
    "line",
    [
        b"\xff\xfe", b"5", b"[]", b"{}", b'{"kind":"warp"}', b'{"kind":["depth"]}', b"[" * 100_000,
        b'{"kind":"velocity","t_ns":1,"arrival_ns":1,"source":"d","velocity_m_s":[1],'
        b'"figure_of_merit_m_s":1}', b"x" * (3 * LONGEST_LINE),
    ],
)  # fmt: skip
def test_a_damaged_line_costs_itself(tmp_path: Path, line: bytes) -> None:
    path = written(tmp_path / "t.jsonl", SAMPLES[:1])
    path.write_bytes(line + b"\n" + path.read_bytes())
    lines = TelemetryLines(path)
    assert list(lines.samples()) == SAMPLES[:1]
    assert lines.damaged == 1
    with pytest.raises(ValueError, match=r"."):
        of_line(line)


def test_a_sample_that_is_not_finite_is_left_out(tmp_path: Path) -> None:
    path = written(tmp_path / "t.jsonl", [Depth(*STAMP, float("nan")), SAMPLES[0]])
    assert list(TelemetryLines(path).samples()) == SAMPLES[:1]


def test_a_full_disk_costs_samples_and_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = Path("/dev/full").open("ab")  # noqa: SIM115 - the log closes it
    monkeypatch.setattr(telemetry_lines, "open_to_append", lambda path: full)
    log = TelemetryWriter(tmp_path / "telemetry.jsonl")
    for _ in range(100):  # more than waits in memory
        log.add(SAMPLES)
    assert 0 < log.lost < 100 * len(SAMPLES)
    log.close()
    log.close()


def test_a_dives_telemetry_is_a_log_for_another_recording_of_it(tmp_path: Path) -> None:
    path = written(tmp_path / "telemetry.jsonl", SAMPLES)
    assert DiveTelemetry.recognises(path)
    log = DiveTelemetry.open(path, starts_s=2.5)
    again = list(log.samples())
    assert {(s.t_ns, s.arrival_ns) for s in again} == {(2_500_000_000, 2_500_000_007)}
    assert [type(s) for s in again] == [type(s) for s in SAMPLES]
    assert log.notes == []
    path.write_bytes(path.read_bytes() + b"torn")
    assert len(list(log.samples())) == len(SAMPLES)
    assert "1 damaged line" in log.notes[0]


def test_arrivals_on_another_clock_do_not_move_the_samples(tmp_path: Path) -> None:
    played = [Depth(7 * SECOND, 10**15, "d", 1.0), Depth(8 * SECOND, 10**15 + 5, "d", 2.0)]
    log = DiveTelemetry.open(written(tmp_path / "telemetry.jsonl", played))
    assert [(s.t_ns, s.arrival_ns) for s in log.samples()] == [(0, 0), (SECOND, SECOND)]


def test_lines_of_something_else_are_not_telemetry(tmp_path: Path) -> None:
    other = tmp_path / "log.jsonl"
    other.write_text('{"t": 1.0, "level": "info"}\n')
    assert not DiveTelemetry.recognises(other)
    assert not DiveTelemetry.recognises(tmp_path / "missing.jsonl")
