"""ROS 1 and ROS 2 bags, written here by rosbags and read as sources."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from aquaflow.base.errors import InputError
from aquaflow.config.service import RecordingConfig
from aquaflow.live.recorder.writing import encode
from aquaflow.recordings.rosbag import messages_in
from aquaflow.recordings.rosbag_camera import RosbagCamera
from aquaflow.sources import open_recorded_telemetry, open_recording
from aquaflow.types import (
    Acceleration,
    Altitude,
    AngularRate,
    Attitude,
    Depth,
    Dropped,
    Frame,
    Position,
    UtcTime,
    Velocity,
)
from tests.recordings.inputs.bags import Messages

SECOND = 1_000_000_000
BEGAN_NS = 1_700_000_000 * SECOND
LATE_NS = 20_000_000
KINDS = ("ros1", "ros2", "ros2mcap")


def dive(messages: Messages) -> Iterator[tuple[str, int, Any]]:
    """Topic, time and message: three pictures a second apart and one sample of every kind."""
    make, vector = messages.make, messages.vector
    roi = make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    k = np.array([50.0, 0, 31.5, 0, 51.0, 23.5, 0, 0, 1])
    d, r, p = np.array([0.1, 0.01, 0.0, 0.0, 0.0]), np.eye(3).ravel(), np.zeros(12)
    yield "/cam/camera_info", 0, make(
        "sensor_msgs/msg/CameraInfo",
        messages.header(BEGAN_NS), 48, 64, "plumb_bob", d, k, r, p, 0, 0, roi,
    )  # fmt: skip
    for second in range(3):
        image = np.full((48, 64, 3), 10 * second + 5, np.uint8)
        header = messages.header(BEGAN_NS + second * SECOND)
        png = np.frombuffer(encode(image, RecordingConfig(picture="png")).data, np.uint8)
        name = "sensor_msgs/msg/CompressedImage"
        yield "/cam/image/compressed", second * SECOND, make(name, header, "png", png)
    header = messages.header(BEGAN_NS + SECOND)
    q = make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.5**0.5, 0.5**0.5)
    told, untold = np.zeros(9), np.array([-1.0] + [0.0] * 8)
    imu = "sensor_msgs/msg/Imu"
    rate, force = vector(0.1, 0.2, 0.3), vector(0.0, 0.0, 9.81)
    yield "/imu", SECOND, make(imu, header, q, told, rate, told, force, untold)
    yield "/imu2", SECOND, make(imu, header, q, untold, rate, untold, force, told)
    pressure = 101_325.0 + 1029.0 * 9.80665 * 12.0
    yield "/depth", SECOND, make("sensor_msgs/msg/FluidPressure", header, pressure, 0.0)
    sonar = "sensor_msgs/msg/Range"
    yield "/sonar", SECOND, make(sonar, header, 0, 0.1, 0.2, 50.0, 3.5)
    yield "/sonar", SECOND, make(sonar, header, 0, 0.1, 0.2, 50.0, 60.0)
    twist = make("geometry_msgs/msg/Twist", vector(0.5, 0.1, -0.2), vector(0.0, 0.0, 0.0))
    covariance = np.diag([0.01, 0.04, 0.01, 0, 0, 0]).ravel()
    told_twist = make("geometry_msgs/msg/TwistWithCovariance", twist, covariance)
    place = (-41.25, 174.8, 0.0, np.diag([0.04, 0.08, 9.0]).ravel())
    nowhere = (0.0, 0.0, *place[2:])
    receivers = (
        *(("/gnss", 0, place, 2), ("/gnss/rough", 0, place, 0)),
        *(("/gnss/lost", -1, place, 2), ("/gnss/nowhere", 0, nowhere, 2)),
    )
    for topic, status, values, kind in receivers:
        receiver = make("sensor_msgs/msg/NavSatStatus", status, 1)
        fix = make("sensor_msgs/msg/NavSatFix", header, receiver, *values, kind)
        yield topic, SECOND, fix
    yield "/dvl", SECOND, make("geometry_msgs/msg/TwistWithCovarianceStamped", header, told_twist)


@pytest.fixture(params=KINDS)
def bag(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    messages = Messages(request.param == "ros1")
    path = tmp_path / ("a.bag" if messages.ros1 else "bag")
    storage = StoragePlugin.MCAP if request.param == "ros2mcap" else StoragePlugin.SQLITE3
    opened: Any = (
        Writer1(path) if messages.ros1 else Writer2(path, version=9, storage_plugin=storage)
    )
    with opened as writer:
        connections: dict[str, Any] = {}
        for topic, t_ns, message in dive(messages):
            if topic not in connections:
                kind = message.__msgtype__
                connections[topic] = writer.add_connection(topic, kind, typestore=messages.store)
            data = messages.serialized(message)
            writer.write(connections[topic], BEGAN_NS + t_ns + LATE_NS, data)
    return path


def test_pictures_have_their_headers_times_and_the_calibration(bag: Path) -> None:
    camera = open_recording(bag)
    assert isinstance(camera, RosbagCamera)
    assert camera.frame_count == 3
    frames = list(camera.frames())
    assert [frame.t_ns for frame in frames] == [0, SECOND, 2 * SECOND]
    assert [f.arrival_ns - f.t_ns for f in frames if isinstance(f, Frame)] == [LATE_NS] * 3
    assert [int(f.image[0, 0, 0]) for f in frames if isinstance(f, Frame)] == [5, 15, 25]
    assert camera.camera is not None
    assert (camera.camera.fx, camera.camera.cx, camera.camera.cy) == (50.0, 32.0, 24.0)
    assert camera.camera.distortion_model == "radtan"
    assert [frame.index for frame in camera.frames(every=2)] == [0, 2]


def test_telemetry_is_turned_from_ros_axes_to_ours(bag: Path) -> None:
    everything = list(open_recorded_telemetry(bag).samples())
    samples = [s for s in everything if not isinstance(s, (Position, UtcTime))]
    assert {sample.t_ns for sample in samples} == {SECOND}
    assert {sample.arrival_ns for sample in samples} == {SECOND + LATE_NS}
    by_kind = {type(sample): sample for sample in samples}
    assert len(samples) == len(by_kind) == 6
    # Forward points north: turned by 90 degrees from east in ROS, not at all for us.
    attitude, rate = by_kind[Attitude], by_kind[AngularRate]
    assert isinstance(attitude, Attitude)
    assert isinstance(rate, AngularRate)
    assert np.abs(attitude.wxyz) == pytest.approx([1.0, 0.0, 0.0, 0.0], abs=1e-12)
    assert rate.rate_rad_s == pytest.approx((0.1, -0.2, -0.3))
    force, velocity = by_kind[Acceleration], by_kind[Velocity]
    assert isinstance(force, Acceleration)
    assert isinstance(velocity, Velocity)
    assert force.acceleration_m_s2 == pytest.approx((0.0, 0.0, -9.81))
    assert velocity.velocity_m_s == pytest.approx((0.5, -0.1, 0.2))
    assert velocity.figure_of_merit_m_s == pytest.approx(0.2)
    depth, altitude = by_kind[Depth], by_kind[Altitude]
    assert isinstance(depth, Depth)
    assert isinstance(altitude, Altitude)
    assert depth.depth_m == pytest.approx(12.0)
    assert altitude.altitude_m == pytest.approx(3.5)


def test_a_fix_is_as_accurate_as_its_covariance_and_no_fix_is_none(bag: Path) -> None:
    telemetry = open_recorded_telemetry(bag)
    fix, rough = [s for s in telemetry.samples() if isinstance(s, Position)]
    assert (fix.latitude_deg, fix.longitude_deg, fix.source) == (-41.25, 174.8, "gnss")
    assert (fix.t_ns, fix.arrival_ns) == (SECOND, SECOND + LATE_NS)
    assert fix.sigma_m == pytest.approx(0.06**0.5)
    assert rough.sigma_m == pytest.approx(2.0 * 5.1 / 2**0.5)
    assert telemetry.notes == ["1 messages of " + bag.name + " make no sense"]


def test_a_damaged_bag_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(300))
    with pytest.raises(InputError, match=r"cannot read the bag .*a\.bag"):
        open_recording(tmp_path / "a.bag")


def test_a_bag_without_pictures_is_telemetry_only(tmp_path: Path) -> None:
    messages = Messages(ros1=True)
    with Writer1(tmp_path / "a.bag") as writer:
        topic, t_ns, message = next(e for e in dive(messages) if e[0] == "/depth")
        connection = writer.add_connection(topic, message.__msgtype__, typestore=messages.store)
        writer.write(connection, BEGAN_NS + t_ns, messages.serialized(message))
    with pytest.raises(InputError, match="holds no picture"):
        open_recording(tmp_path / "a.bag")
    utc, sample = open_recorded_telemetry(tmp_path / "a.bag").samples()
    assert utc == UtcTime(0, 0, "a/bag", BEGAN_NS + t_ns)
    assert isinstance(sample, Depth)
    assert not isinstance(sample, Dropped)
    assert sample.arrival_ns == 0


@pytest.mark.parametrize("text", [b"\xff\xfe", b"rosbag2_bagfile_information: 3\n", b"a: *x\n"])
def test_a_bag_with_damaged_metadata_is_one_sentence(tmp_path: Path, text: bytes) -> None:
    (tmp_path / "a.db3").write_bytes(b"")
    (tmp_path / "metadata.yaml").write_bytes(text)
    with pytest.raises(InputError, match="cannot read the bag"):
        open_recording(tmp_path)


def test_a_bag_whose_storage_is_damaged_is_used_up_to_the_damage() -> None:
    class Damaged:
        """A reader as rosbags has it, whose second message cannot be read."""

        def messages(self, connections: list[str]) -> Iterator[tuple[str, int, bytes]]:
            yield connections[0], 1, b"whole"
            raise RuntimeError("database disk image is malformed")

    notes: list[str] = []
    reader: Any = Damaged()
    connections: Any = ["/imu"]
    assert list(messages_in(reader, connections, notes)) == [("/imu", 1, b"whole")]
    assert notes == ["the bag is damaged; all before the damage is used"]


def test_a_cut_database_is_a_note_or_one_sentence(bag: Path) -> None:
    whole = bag if bag.is_file() else next(f for f in bag.iterdir() if f.suffix != ".yaml")
    content = whole.read_bytes()
    for share in (0.3, 0.6, 0.9, 0.99):
        whole.write_bytes(content[: int(share * len(content))])
        with contextlib.suppress(InputError):
            camera = open_recording(bag)
            assert len(list(camera.frames())) == 3 or camera.notes
