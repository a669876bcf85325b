"""Logs of NMEA sentences: whose time is whose."""

from __future__ import annotations

from pathlib import Path

import pytest

from aquaflow.recordings.link_logs import NmeaText


@pytest.mark.parametrize(
    ("lines", "expected_s", "said"),
    [
        (["$GPGGA,235959.50,", "$SDDBT,1,f,2,M", "$GPGGA,000001.00,"], [0, 0, 1.5], "UTC in its"),
        (["$GNRMC,120000,A", "$GNRMC,120019,A"], [0, 19], "UTC in its sentences"),
        (["$GPGLL,1,N,2,E,120000.25,A", "$GPGLL,1,N,2,E,120001,A"], [0, 0.75], "UTC in its"),
        (["$SDDBT,1,f,2,M", "$SDDBT,1,f,2,M"], [0, 0.1], "10 lines a second are assumed"),
        (["12.5 $GPGGA,120000,", "13.0 $GPGGA,120009,"], [0, 0.5], ""),
    ],
)
def test_a_lines_time_is_its_own(
    tmp_path: Path, lines: list[str], expected_s: list[float], said: str
) -> None:
    log = tmp_path / "log.nmea"
    log.write_text("\n".join(lines))
    text = NmeaText(log)
    assert [read.arrival_ns * 1e-9 for read in text.reads()] == pytest.approx(expected_s)
    assert said in " ".join(text.notes)
