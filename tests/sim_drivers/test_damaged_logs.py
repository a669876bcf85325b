"""Damage that the fuzzer found: it costs the records or files that it hit, and no more."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from aquaflow.base.errors import InputError
from aquaflow.config.service import RecordingConfig
from aquaflow.lab.synthetic.telemetry import HEADER
from aquaflow.live.recorder.writing import encode
from aquaflow.recordings.csv_telemetry import CsvTelemetry
from aquaflow.recordings.dataflash import Dataflash
from aquaflow.recordings.link_logs import Tlog
from aquaflow.recordings.mcap_camera import OURS, McapCamera
from aquaflow.recordings.mcap_messages import McapMessages
from aquaflow.types import Acceleration, Depth

ZEROS = bytes(1 << 22)


def described(kind: int, name: bytes, codes: bytes, labels: bytes) -> bytes:
    """The record that says what records of ``kind`` hold."""
    sizes = {"Q": 8, "f": 4, "N": 16}
    length = 3 + sum(sizes[chr(code)] for code in codes)
    return b"\xa3\x95" + struct.pack("<BBB4s16s64s", 128, kind, length, name, codes, labels)


def height(kind: int, metres: float) -> bytes:
    return b"\xa3\x95" + struct.pack("<BQf", kind, 1000, metres)


def test_records_of_a_damaged_description_cost_themselves(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(
        described(1, b"CTUN", b"Qf", b"TimeUS,Alt") + described(2, b"CTUN", b"Qf", b"TimeUS,Elt")
        + described(3, b"CTUN", b"Nf", b"TimeUS,Alt")
        + height(1, -2.0) + height(2, -3.0) + height(1, float("nan")) + height(1, -4.0)
        + b"\xa3\x95" + struct.pack("<B16sf", 3, b"no number", -5.0)
    )  # fmt: skip
    log = Dataflash(tmp_path / "a.bin")
    assert [s.depth_m for s in log.samples() if isinstance(s, Depth)] == [2.0, 4.0]
    assert log.notes == ["3 records of a.bin hold no sane values"]


def test_long_garbage_in_a_log_of_records_is_passed_over(tmp_path: Path) -> None:
    good = described(1, b"CTUN", b"Qf", b"TimeUS,Alt") + height(1, -2.0)
    (tmp_path / "a.bin").write_bytes(good + ZEROS + height(1, -4.0))
    log = Dataflash(tmp_path / "a.bin")
    assert len(list(log.samples())) == 2
    assert log.notes == [f"{len(ZEROS)} bytes of a.bin belong to no record"]


def test_long_garbage_in_a_tlog_is_passed_over(tmp_path: Path) -> None:
    packet = (10**15).to_bytes(8, "big") + b"\xfe\x02" + bytes(8)
    (tmp_path / "a.tlog").write_bytes(packet + ZEROS + packet + packet)
    log = Tlog(tmp_path / "a.tlog")
    assert len(list(log.reads())) == 3
    assert log.notes == [f"{len(ZEROS)} bytes of a.tlog belong to no record"]


def test_a_table_ends_where_it_is_no_table_any_more(tmp_path: Path) -> None:
    path = tmp_path / "dive_accl.csv"
    path.write_text("t_s,c0,c1,c2\n1.0,1,2,3\n1e999,1,2,3\n" + "\0" * 200_000 + "\n1.5,1,2,3\n")
    log = CsvTelemetry(path)
    (sample,) = log.samples()
    assert isinstance(sample, Acceleration)
    assert len(log.notes) == 2
    assert log.notes[0].startswith("dive_accl.csv is damaged after line ")
    assert log.notes[1] == "1 lines of dive_accl.csv were left out"


@pytest.mark.parametrize("time", ["1e999", "\0" * 200_000])
def test_a_synthetic_dives_table_with_an_endless_number_is_refused(
    tmp_path: Path, time: str
) -> None:
    path = tmp_path / "telemetry.csv"
    path.write_text(f"{','.join(HEADER)}\n{time},0.6,depth,synthetic,3.25,,,\n")
    with pytest.raises(InputError, match=r"telemetry\.csv holds a line"):
        list(CsvTelemetry(path).samples())


def test_an_mcap_file_that_cannot_be_opened_costs_itself(tmp_path: Path) -> None:
    (tmp_path / "0000.mcap").mkdir()
    (tmp_path / "0001.mcap").symlink_to("0001.mcap")
    messages = McapMessages([tmp_path / "0000.mcap", tmp_path / "0001.mcap"])
    assert messages.counts is None
    assert list(messages) == []
    assert [note.partition(" cannot be read: ")[0] for note in messages.notes] == [
        "0000.mcap", "0001.mcap",
    ]  # fmt: skip


def a_recording(path: Path, model: str) -> None:
    """Two pictures as AquaFlow records them, with ``model`` as what is known of the camera."""
    picture = encode(np.full((4, 6, 3), 90, np.uint8), RecordingConfig(picture="png")).data
    message = json.dumps({"format": "png", "data": base64.b64encode(picture).decode()}).encode()
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata(OURS, {})
        writer.add_metadata("camera:cam", {"model": model})
        schema = writer.register_schema("foxglove.CompressedImage", "jsonschema", b"{}")
        channel = writer.register_channel("/cam/image", "json", schema)
        for number in range(2):
            writer.add_message(channel, number, message, number, number)
        writer.finish()


@pytest.mark.parametrize(
    "model", ["{", "[]", '{"width": 6}', '{"distortion": [], "port": {"x": 1}}']
)
def test_a_damaged_calibration_in_a_recording_is_left_out(tmp_path: Path, model: str) -> None:
    a_recording(tmp_path / "a.mcap", model)
    camera = McapCamera(tmp_path / "a.mcap")
    assert camera.camera is None
    assert len(list(camera.frames())) == 2
    assert "the calibration in a.mcap is damaged and was left out" in camera.notes


def test_topics_of_others_that_are_named_as_ours_are_theirs(tmp_path: Path) -> None:
    a_recording(tmp_path / "a.mcap", "{}")
    picture = next(iter(McapMessages([tmp_path / "a.mcap"])))
    with (tmp_path / "b.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("foxglove.CompressedImage", "jsonschema", b"{}")
        for name, data in (("image", picture.data), ("exposure", b"\x08\x01"), ("mask", b"?")):
            channel = writer.register_channel(f"/cam/{name}", "json", schema)
            writer.add_message(channel, 0, data, 0)
        writer.add_message(channel - 2, 1, picture.data, 1)
        writer.finish()
    assert len(list(McapCamera(tmp_path / "b.mcap").frames())) == 2
