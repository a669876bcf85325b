"""Telemetry logs of every kind as sources; byte logs go through the live links' decoders."""

from __future__ import annotations

import json
import random
from collections import Counter
from pathlib import Path

import pytest
from PIL import Image

from aquaflow.base.errors import ConfigError, InputError
from aquaflow.config.link import SerialConfig
from aquaflow.config.stage import MountingConfig
from aquaflow.config.telemetry import NmeaConfig
from aquaflow.recordings.csv_telemetry import CsvTelemetry
from aquaflow.recordings.dataflash import Dataflash
from aquaflow.recordings.images import ImageFolder
from aquaflow.recordings.link_logs import Candump, NmeaText, Tlog
from aquaflow.recordings.manifest import ManifestTelemetry
from aquaflow.recordings.telemetry_log import LogTime
from aquaflow.sources import (
    mounting_of,
    open_recorded_telemetry,
    open_recording,
    telemetry_reader,
)
from aquaflow.types import (
    Acceleration,
    Altitude,
    AngularRate,
    Attitude,
    Depth,
    Position,
    TelemetrySample,
    UtcTime,
    Velocity,
)

SECOND = 1_000_000_000
DEPTH_BELOW = "$SDDBT,32.8,f,10.0,M,5.4,F*0F"


def of_kind(samples: list[TelemetrySample], kind: type) -> list[TelemetrySample]:
    return [sample for sample in samples if type(sample) is kind]


def pymavlinks_counts(path: Path) -> Counter[str]:
    from pymavlink import mavutil

    log = mavutil.mavlink_connection(str(path))
    counts: Counter[str] = Counter()
    while (message := log.recv_msg()) is not None:
        counts[message.get_type()] += 1
    return counts


def test_a_tlogs_counts_are_those_of_pymavlinks_own_reader(shared_data: Path) -> None:
    path = shared_data / "vehicle_logs" / "ardusub_small.tlog"
    log = Tlog(path)
    samples = list(log.samples())
    theirs = pymavlinks_counts(path)
    assert log.counters.messages == sum(theirs.values()) - theirs["BAD_DATA"] == 35_912
    assert log.counters.bad_checksums == theirs["BAD_DATA"] == 4
    assert len(of_kind(samples, Attitude)) == theirs["ATTITUDE"]
    assert len(of_kind(samples, Depth)) == theirs["SCALED_PRESSURE2"]
    assert len(of_kind(samples, Acceleration)) == theirs["RAW_IMU"]
    assert samples[-1].arrival_ns == pytest.approx(263 * SECOND, abs=SECOND)
    # Its 528 fixes came from an acoustic system by GPS_INPUT and are one, sent again and again; the
    # autopilot's clock was never set.
    (fix,) = of_kind(samples, Position)
    assert (fix.latitude_deg, fix.longitude_deg) == pytest.approx((48.3861418, -124.6305732))
    assert fix.sigma_m == pytest.approx(1.6 * 5.1 / 2**0.5)
    times = of_kind(samples, UtcTime)
    assert {utc.source for utc in times} == {"ardusub_small/log"}
    assert len(times) == 27
    assert len({utc.utc_ns - utc.t_ns for utc in times}) == 1


def tlog_of(path: Path, stamps_us: list[int]) -> Tlog:
    packet = b"\xfe\x02" + bytes(8)
    path.write_bytes(b"".join(us.to_bytes(8, "big") + packet for us in stamps_us))
    return Tlog(path, starts_s=2.0)


BEGAN_US = 1_795_365_000_000_000


def test_a_tlogs_stamps_are_utc_every_ten_seconds(tmp_path: Path) -> None:
    seconds = range(25)
    log = tlog_of(tmp_path / "a.tlog", [BEGAN_US + 1_000_000 * s for s in seconds])
    assert list(log.samples()) == [
        UtcTime((2 + s) * SECOND, (2 + s) * SECOND, "a/log", 1000 * BEGAN_US + s * SECOND)
        for s in (0, 10, 20)
    ]


@pytest.mark.parametrize("set_to_us", [BEGAN_US - 60_000_000, BEGAN_US + 7_200_000_000])
def test_a_tlog_whose_clock_was_set_gives_no_utc(tmp_path: Path, set_to_us: int) -> None:
    stamps = [BEGAN_US, BEGAN_US + 1_000_000, set_to_us, set_to_us + 1_000_000]
    log = tlog_of(tmp_path / "a.tlog", stamps)
    assert list(log.samples()) == []
    assert log.notes == ["the clock of a.tlog was set once and gives no UTC"]


def test_a_tlog_from_a_computer_without_a_clock_gives_no_utc(tmp_path: Path) -> None:
    assert list(tlog_of(tmp_path / "a.tlog", [1_000_000, 2_000_000]).samples()) == []


def test_flipped_bytes_in_a_tlog_cost_the_packets_hit(shared_data: Path, tmp_path: Path) -> None:
    data = bytearray((shared_data / "vehicle_logs" / "ardusub_small.tlog").read_bytes()[:100_000])
    (tmp_path / "whole.tlog").write_bytes(data)
    whole, hurt = Tlog(tmp_path / "whole.tlog"), Tlog(tmp_path / "hurt.tlog")
    rng = random.Random(0)
    hits = rng.sample(range(len(data)), 100)
    for at in hits:
        data[at] ^= rng.randrange(1, 256)
    hurt.path.write_bytes(data)
    assert list(whole.samples()) == list(whole.samples())
    assert list(hurt.samples())
    assert whole.counters.messages - hurt.counters.messages <= len(hits)
    assert hurt.counters.messages > 0.9 * whole.counters.messages


def test_a_dataflash_logs_records_are_those_of_pymavlinks_own_reader(shared_data: Path) -> None:
    path = shared_data / "vehicle_logs" / "ardusub_small.BIN"
    log = Dataflash(path)
    assert Counter(name for name, _ in log.records()) == pymavlinks_counts(path)
    assert log.notes == []
    samples = list(log.samples())
    kinds = Counter(type(sample) for sample in samples)
    assert kinds == {Attitude: 237, AngularRate: 594, Acceleration: 594, Depth: 237}
    force = of_kind(samples, Acceleration)[0]
    assert isinstance(force, Acceleration)
    assert force.acceleration_m_s2[2] == pytest.approx(-9.77, abs=0.01)


def test_garbage_in_a_dataflash_log_costs_the_record_hit(shared_data: Path, tmp_path: Path) -> None:
    data = (shared_data / "vehicle_logs" / "ardusub_small.BIN").read_bytes()
    (tmp_path / "a.bin").write_bytes(data[:150_000] + b"\xa3\x95\xff garbage" + data[150_003:])
    log = Dataflash(tmp_path / "a.bin")
    assert sum(1 for _ in log.records()) > 7400
    assert "belong to no record" in log.notes[0]


def test_a_candump_log_is_decoded_as_the_bus_is(tmp_path: Path) -> None:
    """Water depth 12.34 m (PGN 128267), the frame that was decoded by another library."""
    log = tmp_path / "bus.log"
    log.write_text(
        "(1436509053.249713) can0 0DF50B23#01D20400000000FF\n"
        "not a frame\n"
        "(1436509053.749713) can0 123#R\n"
        "(1436509054.249713) can0 0DF50B23#02D20400000000FF\n"
    )
    utc, first, second = Candump(log).samples()
    assert utc == UtcTime(0, 0, "bus/log", 1_436_509_053_249_713_000)
    assert isinstance(first, Altitude)
    assert first.altitude_m == pytest.approx(12.34)
    assert (first.arrival_ns, second.arrival_ns) == (0, SECOND)


@pytest.mark.parametrize(
    ("lines", "arrivals_s"),
    [
        (["1372687208.5 ", "1372687209.5 ", "1372687211 "], [0.0, 1.0, 2.5]),
        (["2013-07-01T14:00:08Z,", "2013-07-01T14:00:08.250Z,", ""], [0.0, 0.25, 0.25]),
        (["", "", ""], [0.0, 0.1, 0.2]),
        (["5.0\t", "4.0\t", "4.5\t"], [0.0, 0.0, 0.5]),
    ],
)
def test_nmea_lines_have_the_times_that_the_logger_wrote(
    tmp_path: Path, lines: list[str], arrivals_s: list[float]
) -> None:
    path = tmp_path / "a.nmea"
    path.write_text("".join(f"{line}{DEPTH_BELOW}\n" for line in lines))
    samples = [s for s in NmeaText(path, starts_s=7.0).samples() if not isinstance(s, UtcTime)]
    assert [sample.arrival_ns * 1e-9 - 7.0 for sample in samples] == pytest.approx(arrivals_s)
    assert all(isinstance(s, Altitude) and s.altitude_m == 10.0 for s in samples)


def test_nmea_lines_with_a_wall_clock_give_utc(tmp_path: Path) -> None:
    path = tmp_path / "a.nmea"
    path.write_text(f"2013-07-01T14:00:08Z,{DEPTH_BELOW}\n{DEPTH_BELOW}\n")
    utc, *others = NmeaText(path).samples()
    assert utc == UtcTime(0, 0, "a/log", 1_372_687_208 * SECOND)
    assert {type(sample) for sample in others} == {Altitude}


def test_a_logs_clock_that_was_set_does_not_move_the_dive() -> None:
    clock = LogTime()
    day = 86_400 * SECOND
    stamps = [day, day + SECOND, 5 * day, 5 * day + SECOND, day, day + SECOND]
    assert [clock.at(stamp) for stamp in stamps] == [
        second * SECOND for second in (0, 1, 1, 2, 2, 3)
    ]
    assert clock.jumps == 2


def test_tables_of_the_shared_data_are_read(shared_data: Path) -> None:
    logs = shared_data / "vehicle_logs"
    depths = list(open_recorded_telemetry(logs / "girona_depth_sensor.csv").samples())
    assert len(depths) == 19_553
    assert isinstance(depths[0], Depth)
    assert depths[0].depth_m == pytest.approx(12.954, abs=1e-3)
    dvl = list(CsvTelemetry(logs / "girona_dvl_linkquest.csv").samples())
    assert len(of_kind(dvl, Velocity)) == 5082
    assert all(sample.t_ns <= sample.arrival_ns for sample in dvl)


def test_a_gopros_gravity_points_down(shared_data: Path) -> None:
    forces = list(CsvTelemetry(shared_data / "reef_clip" / "gopro_accl.csv").samples())
    mean = [
        sum(s.acceleration_m_s2[k] for s in forces if isinstance(s, Acceleration)) / len(forces)
        for k in range(3)
    ]
    assert sum(value**2 for value in mean) ** 0.5 == pytest.approx(9.81, abs=0.3)
    assert mean[2] < -8.5


def test_a_line_without_numbers_costs_itself(tmp_path: Path) -> None:
    path = tmp_path / "depth.csv"
    path.write_text("%time,field.header.stamp,field.depth\n10,10,1.5\n20,20,nan\n30,x,2\n40,40,2\n")
    log = CsvTelemetry(path)
    assert [s.depth_m for s in log.samples() if isinstance(s, Depth)] == [1.5, 2.0]
    assert log.notes == ["2 lines of depth.csv were left out"]


def test_other_tables_are_no_telemetry(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x,y\n1,2\n")
    assert telemetry_reader(tmp_path / "a.csv") is None
    with pytest.raises(InputError, match="has none of the columns"):
        open_recorded_telemetry(tmp_path / "a.csv")


def test_a_synthetic_dive_brings_its_instruments(pictures: Path) -> None:
    (pictures / "synth.yaml").write_text("")
    (pictures / "telemetry.csv").write_text(
        "t_s,arrival_s,kind,source,v0,v1,v2,v3\n0.5,0.6,depth,synthetic,3.25,,,\n"
    )
    (sample,) = open_recorded_telemetry(pictures).samples()
    assert sample == Depth(SECOND // 2, 600_000_000, "synthetic", 3.25)


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    (tmp_path / "images").mkdir()
    for k in range(3):
        Image.new("RGB", (16, 12), (k, 0, 0)).save(tmp_path / "images" / f"{k}.png")
    return tmp_path


@pytest.fixture
def dive(tmp_path: Path, pictures: Path) -> Path:
    """Pictures with two logs beside them, the second begins 2 s later and is turned round."""
    for name in ("a.nmea", "b.nmea"):
        (tmp_path / name).write_text(f"1.0 {DEPTH_BELOW}\n2.0 $GPHDT,90.0,T*0C\n")
    device = NmeaConfig(link=SerialConfig(port="log"), mounting=MountingConfig(yaw_deg=180.0))
    level = device.model_dump(mode="json") | {"assume": {"level": True}}
    entries = [{"file": "a.nmea"}, {"file": "b.nmea", "starts_s": 2.0, "device": level}]
    (tmp_path / "replay.yaml").write_text(json.dumps({"camera": "images", "telemetry": entries}))
    return tmp_path


def test_a_manifest_brings_pictures_and_logs_together(dive: Path) -> None:
    assert isinstance(open_recording(dive), ImageFolder)
    samples = list(open_recorded_telemetry(dive).samples())
    assert [(s.source.split("/")[0], s.arrival_ns // SECOND) for s in samples] == [
        ("a", 0), ("b", 2), ("b", 3)
    ]  # fmt: skip
    assert isinstance(samples[-1], Attitude)
    assert abs(samples[-1].wxyz[0]) == pytest.approx(0.5**0.5)


def test_a_manifest_states_how_its_camera_is_mounted(pictures: Path) -> None:
    (pictures / "replay.yaml").write_text("camera: images\nmounting: {pitch_deg: -90}\n")
    recording = open_recording(pictures)
    assert mounting_of(recording) == MountingConfig(pitch_deg=-90.0)
    assert (recording.frame_count, recording.name_of(1)) == (3, "1.png")
    assert [frame.index for frame in recording.frames(every=2)] == [0, 2]
    [note] = recording.notes
    assert note.startswith("the times of the pictures are not known")


def test_a_logs_bytes_can_be_tapped_as_a_live_links(dive: Path) -> None:
    taken: list[tuple[str, int, bytes]] = []
    telemetry = ManifestTelemetry(dive)
    telemetry.tap_bytes(lambda *read: taken.append(read))
    list(telemetry.samples())
    assert sorted(read[0] for read in taken) == ["a", "a", "b", "b"]
    assert taken[0][2] == DEPTH_BELOW.encode() + b"\r\n"


def test_a_manifest_with_an_unknown_key_is_refused(tmp_path: Path) -> None:
    (tmp_path / "replay.yaml").write_text("camra: x.mp4\n")
    with pytest.raises(ConfigError, match="camra"):
        open_recording(tmp_path)
