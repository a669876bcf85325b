"""Plain tables of a survey: any subset of the columns gives the samples that it can."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

from aquaflow.base.errors import InputError
from aquaflow.recordings.csv_telemetry import CsvTelemetry
from aquaflow.sources import open_recorded_telemetry
from aquaflow.types import Altitude, Attitude, Depth, Position, UtcTime

SECOND = 1_000_000_000


def table(path: Path, text: str, starts_s: float = 0.0) -> CsvTelemetry:
    path.write_text(text, encoding="utf-8")
    assert CsvTelemetry.recognises(path)
    return CsvTelemetry(path, starts_s)


def test_every_column_gives_its_sample(tmp_path: Path) -> None:
    text = (
        "t_s,latitude_deg,longitude_deg,sigma_m,depth_m,roll_deg,pitch_deg,heading_deg,altitude_m\n"
        "1.5,-41.25,174.8,0.3,12.5,0,0,90,2.25\n"
    )
    table(tmp_path / "survey.csv", text)

    fix, depth, attitude, altitude = open_recorded_telemetry(
        tmp_path / "survey.csv", 10.0
    ).samples()

    stamp = (11_500_000_000, 11_500_000_000, "survey")
    assert fix == Position(*stamp, -41.25, 174.8, 0.3)
    assert depth == Depth(*stamp, 12.5)
    assert isinstance(attitude, Attitude)
    assert attitude.wxyz == pytest.approx((math.sqrt(0.5), 0, 0, math.sqrt(0.5)))
    assert altitude == Altitude(*stamp, 2.25)


def test_seconds_stay_as_they_are_and_never_go_back(tmp_path: Path) -> None:
    log = table(tmp_path / "a.csv", "depth_m,t_s\n1,-2\n2,7200\n3,7100\n")

    assert [sample.t_ns // SECOND for sample in log.samples()] == [-2, 7200, 7200]


def test_utc_counts_from_the_first_row_and_is_a_sample_itself(tmp_path: Path) -> None:
    text = (
        "\ufeffutc,depth_m\n2026-11-22T12:00:00.250Z,1\n2026-11-22T13:00:05.25+01:00,2\n"
        "2026-11-22T12:00:11.25,3\n"
    )
    began_ns = 1_795_348_800_250_000_000

    samples = list(table(tmp_path / "a.csv", text, starts_s=3.0).samples())

    assert [(type(s), s.t_ns // SECOND) for s in samples] == [
        (UtcTime, 3), (Depth, 3), (Depth, 8), (UtcTime, 14), (Depth, 14)
    ]  # fmt: skip
    assert [s.utc_ns - s.t_ns for s in samples if isinstance(s, UtcTime)] == [
        began_ns - 3 * SECOND
    ] * 2


def test_a_table_whose_clock_was_set_gives_no_utc(tmp_path: Path) -> None:
    text = "utc,depth_m\n2026-11-22T12:00:00,1\n2026-11-22T11:00:00,2\n"

    assert [type(s) for s in table(tmp_path / "a.csv", text).samples()] == [Depth, Depth]


def test_what_is_known_in_part_makes_no_sample(tmp_path: Path) -> None:
    text = "t_s,latitude_deg,heading_deg,roll_deg,pitch_deg,depth_m\n0,-41.25,90,0,,\n1,,,,,2.0\n"

    assert [type(s) for s in table(tmp_path / "a.csv", text).samples()] == [Depth]


def test_a_position_without_its_accuracy_has_the_usual_one(tmp_path: Path) -> None:
    (fix,) = table(tmp_path / "a.csv", "t_s,latitude_deg,longitude_deg\n0,1,2\n").samples()

    assert isinstance(fix, Position)
    assert fix.sigma_m == pytest.approx(2.0 * 5.1 / math.sqrt(2.0))


@pytest.mark.parametrize(
    "row", ["x,1", "0,x", "nan,1", "inf,1", "0,nan", "0,20000", ",1", "1"], ids=repr
)
def test_a_row_that_makes_no_sense_costs_itself(tmp_path: Path, row: str) -> None:
    log = table(tmp_path / "a.csv", f"t_s,depth_m\n{row}\n2,5\n")
    left_out = [] if row == "1" else ["1 lines of a.csv were left out"]

    assert list(log.samples()) == [Depth(2 * SECOND, 2 * SECOND, "a", 5.0)]
    assert log.notes == left_out


@pytest.mark.parametrize("utc", ["", "yesterday", "1" * 200_000])
def test_a_row_without_a_time_costs_itself(tmp_path: Path, utc: str) -> None:
    log = table(tmp_path / "a.csv", f"utc,depth_m\n2026-11-22T12:00:00,1\n{utc},2\n")

    assert [type(s) for s in log.samples()] == [UtcTime, Depth]
    assert len(log.notes) == 1


@pytest.mark.parametrize(
    ("header", "why"),
    [
        ("t_s", "has none of the columns of a table of telemetry"),
        ("t_s,sigma_m", "has nothing that was measured"),
        ("depth_m,altitude_m", "has no column of time; name it t_s"),
        ("t_s,utc,depth_m", "has two columns of time"),
        ("Time,Depth (m)", "has none of the columns"),
    ],
)
def test_a_table_that_cannot_be_read_says_what_it_lacks(
    tmp_path: Path, header: str, why: str
) -> None:
    (tmp_path / "a.csv").write_text(f"{header}\n1,2,3\n")

    assert not CsvTelemetry.recognises(tmp_path / "a.csv")
    with pytest.raises(InputError, match=re.escape(why)):
        open_recorded_telemetry(tmp_path / "a.csv")


def test_unknown_columns_are_named_and_cost_nothing_else(tmp_path: Path) -> None:
    log = table(tmp_path / "a.csv", "t_s,depth_m,water temperature,heading\n2,5,9.5,30\n")

    assert list(log.samples()) == [Depth(2 * SECOND, 2 * SECOND, "a", 5.0)]
    assert [note.partition(";")[0] for note in log.notes] == [
        "a.csv has columns that AquaFlow does not know and did not use: water temperature, heading"
    ]


def test_a_column_that_says_nothing_alone_is_named(tmp_path: Path) -> None:
    log = table(tmp_path / "a.csv", "t_s,heading_deg,depth_m\n2,90,5\n")

    assert [type(s) for s in log.samples()] == [Depth]
    assert log.notes == ["heading_deg of a.csv could not be used without roll_deg, pitch_deg"]


@pytest.mark.parametrize(
    "text",
    [
        "t_s;depth_m;altitude_m\n2,5;5,25;1,5\n",
        '"t_s";"depth_m";"altitude_m"\r\n"2,5";"5,25";"1,5"\r\n',
        "t_s\tdepth_m\taltitude_m\n2,5\t5.25\t1,5\n",
        '"t_s", "depth_m" ,"altitude_m"\n2.5, 5.25,"1.5"\n',
        "t_s,depth_m,altitude_m\r2.5,5.25,1.5\r",
    ],
    ids=["semicolons", "quoted", "tabs", "spaces", "old Mac"],
)
def test_tables_are_read_as_spreadsheets_write_them(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.csv").write_bytes(text.encode())
    stamp = (2_500_000_000, 2_500_000_000, "a")

    log = open_recorded_telemetry(tmp_path / "a.csv")

    assert list(log.samples()) == [Depth(*stamp, 5.25), Altitude(*stamp, 1.5)]
    assert log.notes == []


def test_a_thousands_comma_is_no_decimal_comma(tmp_path: Path) -> None:
    log = table(tmp_path / "a.csv", 't_s,depth_m\n2,"1,234"\n')

    assert list(log.samples()) == []
    assert log.notes == ["1 lines of a.csv were left out"]


def test_a_table_in_another_encoding_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes("t_s,depth_m,måling °C\n2,5,ø\n".encode("cp1252"))

    assert [type(s) for s in CsvTelemetry(tmp_path / "a.csv").samples()] == [Depth]
