"""Small logs of every kind, and the manifest that names them beside a recording."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path
from typing import Any

import numpy as np
import yaml

LINES = 20
SECOND = 1_000_000_000
BEGAN_NS = 1_700_000_000 * SECOND
DATAFLASH_FIELDS = {
    b"ATT": (1, b"Qccc", b"TimeUS,Roll,Pitch,Yaw"),
    b"CTUN": (2, b"Qf", b"TimeUS,Alt"),
    b"RFND": (3, b"QBf", b"TimeUS,Stat,Dist"),
    b"IMU": (4, b"QBffffff", b"TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
}


def write_logs(root: Path) -> None:
    """The folder ``logged``: pictures and five logs under one ``replay.yaml``."""
    folder = root / "logged"
    shutil.copytree(root / "recording" / "images", folder / "images")
    shutil.copy(root / "recording" / "telemetry.csv", folder / "table.csv")
    (folder / "sounder.nmea").write_bytes(_nmea())
    (folder / "bus.log").write_text(
        "".join(f"({100 + k}.{k:06d}) can0 0DF50B23#01D2{k:02X}00000000FF\n" for k in range(LINES))
    )
    (folder / "pilot.tlog").write_bytes(_tlog())
    (folder / "pilot.bin").write_bytes(_dataflash())
    names = ("table.csv", "sounder.nmea", "bus.log", "pilot.tlog", "pilot.bin")
    logs = [{"file": name, "starts_s": -0.1} for name in names]
    (folder / "replay.yaml").write_text(yaml.safe_dump({"camera": "images", "telemetry": logs}))


def _nmea() -> bytes:
    from aquaflow.sim_drivers.devices.nmea_talker import sentence

    bodies = ("SDDBT,32.8,f,10.0,M,5.4,F", "GPHDT,90.0,T", "HEROT,1.5,A", "VDVBW,,,V,1.0,0.1,A")
    return b"".join(
        b"%.1f %s" % (100 + k / 10, sentence(bodies[k % len(bodies)])) for k in range(LINES)
    )


def _tlog() -> bytes:
    """MAVLink packets with their times."""
    from aquaflow.sim_drivers.devices.ardusub import ArduSub
    from aquaflow.types import Acceleration, AngularRate, Attitude, Depth

    autopilot, log = ArduSub(), b""
    for k in range(LINES):
        t_ns = k * SECOND // 10
        stamp = (t_ns, t_ns, "log")
        for sample in (
            Acceleration(*stamp, (0.0, 0.0, -9.8)),
            AngularRate(*stamp, (0.0, 0.0, 0.1)),
            Attitude(*stamp, (1.0, 0.0, 0.0, 0.0)),
            Depth(*stamp, 2.0 + k),
        ):
            for packet in autopilot.encode(sample, t_ns, t_ns):
                log += (BEGAN_NS // 1000 + t_ns // 1000).to_bytes(8, "big") + packet
    return log


def _dataflash() -> bytes:
    head, sizes = b"\xa3\x95", {"Q": 8, "c": 2, "f": 4, "B": 1}
    codes = {"Q": "Q", "c": "h", "f": "f", "B": "B"}
    log = b""
    for name, (kind, fields, labels) in DATAFLASH_FIELDS.items():
        length = 3 + sum(sizes[chr(code)] for code in fields)
        log += head + struct.pack("<BBB4s16s64s", 128, kind, length, name, fields, labels)
    for k in range(LINES):
        for kind, fields, _labels in DATAFLASH_FIELDS.values():
            values = (1000 * k, *(4 if code == ord("B") else k for code in fields[1:]))
            layout = "<" + "".join(codes[chr(code)] for code in fields)
            log += head + bytes([kind]) + struct.pack(layout, *values)
    return log


def write_bag(root: Path) -> None:
    """A ROS 2 bag with pictures, their calibration and an altitude."""
    import cv2
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)

    def make(name: str, *values: Any) -> Any:
        return store.types[name](*values)

    with Writer(root / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        topics = {
            topic: writer.add_connection(topic, kind, typestore=store)
            for topic, kind in (
                ("/camera/compressed", "sensor_msgs/msg/CompressedImage"),
                ("/sonar", "sensor_msgs/msg/Range"),
            )
        }
        for k, file in enumerate(sorted((root / "recording" / "images").glob("*.png"))):
            t_ns = BEGAN_NS + k * SECOND // 10
            stamp = make("builtin_interfaces/msg/Time", t_ns // SECOND, t_ns % SECOND)
            header = make("std_msgs/msg/Header", stamp, "f")
            coded = cv2.imencode(".jpg", cv2.imread(str(file)))[1].ravel()
            picture = make("sensor_msgs/msg/CompressedImage", header, "jpeg", np.asarray(coded))
            sonar = make("sensor_msgs/msg/Range", header, 0, 0.1, 0.2, 50.0, 3.5)
            for topic, message in (("/camera/compressed", picture), ("/sonar", sonar)):
                data = store.serialize_cdr(message, message.__msgtype__)
                writer.write(topics[topic], t_ns, data)
