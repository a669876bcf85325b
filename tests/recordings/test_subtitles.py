"""Subtitle tracks of ground stations, written here as QGroundControl and Cockpit lay them out."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.recordings.subtitles import Subtitles
from aquaflow.types import Altitude, Attitude, Depth, Position, TelemetrySample, UtcTime

SECOND = 1_000_000_000
HEADER = """[Script Info]
Title: {} Subtitle Telemetry file
ScriptType: v4.00+

[Events]
Format: Layer, Start, End, Style, Name, MarginL, MarginR, MarginV, Effect, Text
"""


def stamp(t_s: float) -> str:
    return f"{int(t_s // 3600)}:{int(t_s // 60 % 60):02d}:{t_s % 60:05.2f}"


def dialogue(begin_s: float, text: str, style: str = "Default") -> str:
    return f"Dialogue: 0,{stamp(begin_s)},{stamp(begin_s + 1)},{style},,0,0,0,,{text}"


def written(path: Path, program: str, lines: list[str]) -> Subtitles:
    path.write_text(HEADER.format(program) + "\n".join(lines) + "\n", encoding="utf-8")
    assert Subtitles.recognises(path)
    return Subtitles(path, starts_s=5.0)


def qgroundcontrol(begin_s: int, depth: str = "-3.2 m") -> list[str]:
    columns = (
        ("Depth:\\NHeading:", f"{depth}\\N271 deg"),
        ("Roll:\\NPitch:", "10.0 deg\\N-5.0 deg"),
        ("Rangefinder:\\NAltitude:", "2.50 m\\N-3.1 m"),
    )
    lines = []
    for k, (names, values) in enumerate(columns):
        lines.append(dialogue(begin_s, f"{{\\an3\\pos({300 * k},1075)}}{names}"))
        lines.append(dialogue(begin_s, f"{{\\pos({300 * k},1075)}}{values}"))
    return [*lines, dialogue(begin_s, "{\\pos(10,35)}11/22/26")]


def cockpit(begin_s: float, clock: str, **shown: str) -> list[str]:
    values = {"Pitch": "-5.0 °", "Roll": "10.0 °", "Heading": "-89.0 °", **shown}
    text = "\\N".join(f"{name}: {value}" for name, value in values.items())
    places = ("LeftBottom", "CenterBotom", "RightBottom", "LeftMid", "CenterMid", "RightMid")
    lines = [dialogue(begin_s, "", place) for place in places]
    lines[0] = dialogue(begin_s, text, "LeftBottom")
    lines[2] = dialogue(begin_s, "Battery voltage: 15.20 V\\NBattery current: 1.0 A", "RightBottom")
    return [*lines, dialogue(begin_s, f"Nov 22, 2026\\N{clock}", "LeftTop")]


def of_kind(samples: list[TelemetrySample], kind: type) -> list:
    return [sample for sample in samples if type(sample) is kind]


def euler_deg(attitude: Attitude) -> np.ndarray:
    """Roll, pitch, yaw."""
    rotation = Rotation.from_quat(np.roll(attitude.wxyz, -1))
    return rotation.as_euler("ZYX", degrees=True)[::-1]


def test_qgroundcontrols_values_are_of_the_end_of_their_second(tmp_path: Path) -> None:
    lines = qgroundcontrol(0) + qgroundcontrol(1, "-4.0 m")
    samples = list(written(tmp_path / "dive.ass", "QGroundControl", lines).samples())

    assert of_kind(samples, Depth) == [
        Depth(6 * SECOND, 6 * SECOND, "dive", 3.2),
        Depth(7 * SECOND, 7 * SECOND, "dive", 4.0),
    ]
    assert euler_deg(of_kind(samples, Attitude)[0]) == pytest.approx([10.0, -5.0, -89.0])
    assert [sample.altitude_m for sample in of_kind(samples, Altitude)] == [2.5, 2.5]
    assert len(samples) == 6, "the date is local time, and no position is shown"


def test_feet_are_read_as_feet(tmp_path: Path) -> None:
    log = written(tmp_path / "a.ass", "QGroundControl", qgroundcontrol(0, "-10.0 ft"))

    assert of_kind(list(log.samples()), Depth)[0].depth_m == pytest.approx(3.048)


def test_cockpits_values_are_of_the_beginning_of_their_entry(tmp_path: Path) -> None:
    place = {"Latitude": "-41.250000 °", "Longitude": "174.800000 °"}
    lines = cockpit(0.25, "14:03:07 GMT-3", Depth="3.200 m", **place)
    lines += cockpit(1.27, "14:03:08 GMT-3", Depth="-0.050 m", **place)
    samples = list(written(tmp_path / "dive.ass", "Cockpit", lines).samples())

    t_ns = round(5.25 * SECOND)
    depth, attitude, fix, utc, *_ = samples
    assert depth == Depth(t_ns, t_ns, "dive", 3.2)
    assert of_kind(samples, Depth)[1].depth_m == -0.05
    assert euler_deg(attitude) == pytest.approx([10.0, -5.0, -89.0])
    assert isinstance(fix, Position)
    assert (fix.latitude_deg, fix.longitude_deg) == (-41.25, 174.8)
    assert fix.sigma_m == pytest.approx(2.0 * 5.1 / math.sqrt(2.0))
    assert isinstance(utc, UtcTime)
    # 17:03:07 UTC, and the second entry shows a time 0.02 s less cut than the first would.
    assert utc.utc_ns == 1_795_366_987 * SECOND


def test_earlier_cockpits_depth_is_an_altitude(tmp_path: Path) -> None:
    lines = cockpit(0, "14:03:07 GMT", Depth="-3.2 m") + cockpit(1, "14:03:08 GMT", Depth="0.1 m")
    lines += cockpit(2, "14:03:09 GMT", Depth="-3.4 m")
    samples = list(written(tmp_path / "a.ass", "Cockpit", lines).samples())

    assert [s.depth_m for s in of_kind(samples, Depth)] == pytest.approx([3.2, -0.1, 3.4])


def test_utc_is_found_to_less_than_the_second_that_is_shown(tmp_path: Path) -> None:
    began_s, lines = 1_795_366_987.4, []
    for k in range(40):
        t_s = round(1.017 * k, 2)
        utc_s = int(began_s + t_s)
        clock = f"{utc_s // 3600 % 24 + 5:02d}:{utc_s // 60 % 60 + 30:02d}:{utc_s % 60:02d}"
        lines += cockpit(t_s, f"{clock} GMT+5:30")
    times = of_kind(list(written(tmp_path / "a.ass", "Cockpit", lines).samples()), UtcTime)

    assert len(times) == 4
    for utc in times:
        assert utc.utc_ns * 1e-9 == pytest.approx(began_s + utc.t_ns * 1e-9 - 5.0, abs=0.03)


def test_a_clock_that_was_set_gives_no_utc(tmp_path: Path) -> None:
    lines = cockpit(0, "14:03:07 GMT") + cockpit(1, "15:03:08 GMT")
    log = written(tmp_path / "a.ass", "Cockpit", lines)

    assert of_kind(list(log.samples()), UtcTime) == []
    assert log.notes == ["the clock of a.ass was set and gives no UTC"]


@pytest.mark.parametrize("day", ["Nov 22, 2026", "Foo 22, 2026"])
def test_a_date_that_is_none_gives_no_utc(tmp_path: Path, day: str) -> None:
    lines = [line.replace("Nov 22, 2026", day) for line in cockpit(0, "14:03:07 GMT")]
    samples = list(written(tmp_path / "a.ass", "Cockpit", lines).samples())

    assert len(of_kind(samples, UtcTime)) == (day == "Nov 22, 2026")


def test_values_that_are_not_there_or_impossible_cost_themselves(tmp_path: Path) -> None:
    nowhere = {"Latitude": "0.000000 °", "Longitude": "0.000000 °"}
    lines = cockpit(0, "", Depth="NaN m", **nowhere) + cockpit(1, "", Depth="99999.0 m")
    lines += cockpit(2, "", Roll="undefined °", Depth="3 fathoms")
    lines += ["Dialogue: 0,garbage", "?"]
    log = written(tmp_path / "a.ass", "Cockpit", lines)

    assert [type(sample) for sample in log.samples()] == [Attitude, Attitude]
    assert log.notes == ["1 entries of a.ass hold no sane values"]
    assert [type(sample) for sample in log.samples()] == [Attitude, Attitude], "as each time"


@pytest.mark.parametrize("name", ["film.ass", "film.srt"])
def test_other_subtitles_are_no_telemetry(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(HEADER.format("Some Film's"))

    assert not Subtitles.recognises(tmp_path / name)
    assert not Subtitles.recognises(tmp_path / "missing.ass")
