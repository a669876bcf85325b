"""A running dive over Foxglove's websocket, read by clients that speak its protocol."""

from __future__ import annotations

import importlib.util
import io
import json
import struct
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from pydantic import ValidationError
from rosbags.typesys import Stores, get_typestore
from websockets.sync.client import connect

from aquaflow.base.errors import InputError
from aquaflow.config.service import FoxgloveConfig
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.dive.placement import placement
from aquaflow.dive.ros import messages, topics
from aquaflow.dive.ros.topics import encode
from aquaflow.live.checkpoint.resume import resume_folder
from aquaflow.live.control import ServiceControl
from aquaflow.live.foxglove.live import LiveFoxglove
from aquaflow.live.foxglove.map_moment import cloud_of, take_map_moment, water_status
from aquaflow.live.foxglove.server import BACKLOG, FoxgloveServer
from aquaflow.live.health.heartbeats import ServiceHealth
from aquaflow.live.live_dive import LiveDive
from aquaflow.live.report import report
from aquaflow.live.service_frontends import ServiceFrontends
from aquaflow.sources import open_recording
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.types import Frame
from aquaflow.water.medium import WaterParameters
from aquaflow.water.mounting import Lamp
from tests.dive.ros.published import HASHES, hash_of
from tests.live.live_scenes import VEHICLE, ToldFeed
from tests.small_recording import GIVE_UP_S

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "ros2" / "aquaflow_node.py"
STORE = get_typestore(Stores.ROS2_JAZZY)
LOOPBACK = FoxgloveConfig(enabled=True, port=0)
BIG = messages.jpeg(1, "camera_optical", np.zeros((8, 8, 3), np.uint8))
Received = dict[str, list[tuple[int, bytes]]]


@pytest.fixture(scope="module")
def example() -> ModuleType:
    """The node of examples/ros2, without its ROS half."""
    spec = importlib.util.spec_from_file_location("aquaflow_node", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def decoded(topic: str, data: bytes) -> Any:
    """By rosbags' definitions of Jazzy; what is sent was encoded by those of Humble."""
    return STORE.deserialize_cdr(data, topics.TYPES[topic])


class Listener:
    """A client in a thread of its own."""

    def __init__(self, example: ModuleType, port: int) -> None:
        self.connection = example.Connection(f"ws://127.0.0.1:{port}")
        self.received: Received = defaultdict(list)
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        try:
            for topic, t_ns, data in self.connection.messages():
                self.received[topic].append((t_ns, data))
        except Exception:  # the connection was closed
            return

    def close(self) -> None:
        self.connection.close()
        self._thread.join(GIVE_UP_S)


def until(condition: Callable[[], bool], do: Callable[[], object] = lambda: None) -> None:
    end = time.monotonic() + GIVE_UP_S
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        do()
        time.sleep(0.02)


@pytest.fixture(scope="module")
def live(
    example: ModuleType, small_recording: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[SimpleNamespace]:
    """A dive that has mapped some frames, and what a client heard of it."""
    folder = tmp_path_factory.mktemp("foxglove") / "dive"
    recording = open_recording(small_recording)
    frames = [frame for frame in recording.frames() if isinstance(frame, Frame)][:12]
    config = FoxgloveConfig(enabled=True, port=0, pose_hz=60.0, refresh_s=0.01, points=200)
    with LiveDive("live", resume_folder(folder, new=False), ToldFeed(), VEHICLE) as dive:
        loop, begun_ns = dive.parts.loop, time.time_ns()
        reports: list[dict[str, Any]] = []

        def reported() -> dict[str, Any]:
            reports.append(report(dive.parts, 1e6))
            return reports[-1]

        foxglove = LiveFoxglove(config, reported)
        loop.watchers.append(foxglove.update)
        listener = Listener(example, foxglove.port)
        until(lambda: foxglove._server.is_wanted(topics.POINTS))
        try:
            for frame in frames:
                loop.take(replace(frame, arrival_ns=time.monotonic_ns()))
            heard = listener.received
            wanted = {
                topics.POINTS,
                topics.RENDERED,
                topics.PATH,
                topics.CAMERA,
                topics.POSE,
                topics.DIAGNOSTICS,
            }
            until(lambda: wanted <= set(heard), lambda: loop.take(None))
            until(lambda: len(heard[topics.TF]) > 1, lambda: loop.take(None))
            until(lambda: has_newest_frame(foxglove, dive, heard), lambda: loop.take(None))
            yield SimpleNamespace(
                dive=dive, heard=heard, connection=listener.connection, begun_ns=begun_ns,
                picture=loop.picture, reported=reports[-1],
            )  # fmt: skip
        finally:
            listener.close()
            foxglove.close()


def has_newest_frame(foxglove: LiveFoxglove, dive: LiveDive, heard: Received) -> bool:
    """Whether what was heard last is of the dive's newest frame."""
    latest = dive.parts.loop.latest
    assert latest is not None
    stamp_ns = foxglove._stamps[latest.frame.index]
    return all(heard[topic][-1][0] == stamp_ns for topic in (topics.POSE, topics.DIAGNOSTICS))


def test_all_topics_are_offered_with_the_definitions_of_ros(live: SimpleNamespace) -> None:
    channels = {channel["topic"]: channel for channel in live.connection.channels.values()}
    assert set(channels) == set(topics.TYPES) - topics.OF_FINISHED_DIVES
    for topic, channel in channels.items():
        assert channel["encoding"] == "cdr"
        assert channel["schemaEncoding"] == "ros2msg"
        name = channel["schemaName"]
        assert name == topics.TYPES[topic]
        assert hash_of(name, channel["schema"]) == HASHES[name]


def test_poses_and_frames_are_those_of_the_dive(live: SimpleNamespace) -> None:
    slam, latest = live.dive.parts.slam, live.dive.parts.loop.latest
    frame = slam.metric_frame(latest.sub_map)
    where = placement(frame)
    T_uc = where.T_un @ frame.pose(latest.T_wc)
    pose = decoded(topics.POSE, live.heard[topics.POSE][-1][1])
    assert pose.header.frame_id == "map"
    place = pose.pose.pose.position
    assert [place.x, place.y, place.z] == pytest.approx(list(T_uc.t), abs=1e-9)
    (link,) = decoded(topics.TF, live.heard[topics.TF][-1][1]).transforms
    assert (link.header.frame_id, link.child_frame_id) == ("map", "camera")
    assert link.transform.translation.x == pytest.approx(T_uc.t[0], abs=1e-9)
    path = decoded(topics.PATH, live.heard[topics.PATH][-1][1])
    assert len(path.poses) >= 1


def test_stamps_are_the_computers_clock(live: SimpleNamespace) -> None:
    for topic in (topics.TF, topics.CAMERA, topics.RENDERED, topics.POINTS):
        for t_ns, data in live.heard[topic]:
            message = decoded(topic, data)
            header = message.transforms[0].header if topic == topics.TF else message.header
            stamp_ns = header.stamp.sec * 1_000_000_000 + header.stamp.nanosec
            assert live.begun_ns <= stamp_ns == t_ns <= time.time_ns()


def test_pictures_and_points_can_be_read(live: SimpleNamespace) -> None:
    for topic in (topics.CAMERA, topics.RENDERED):
        message = decoded(topic, live.heard[topic][-1][1])
        picture = np.asarray(Image.open(io.BytesIO(message.data.tobytes())))
        assert picture.shape == (120, 160, 3)
        assert picture.std() > 5.0
    cloud = decoded(topics.POINTS, live.heard[topics.POINTS][-1][1])
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "rgb", "sigma"]
    points = np.frombuffer(cloud.data.tobytes(), messages.POINT)
    assert 0 < len(points) == cloud.width <= 200
    assert np.isfinite(points["x"]).all()
    assert (points["sigma"] > 0.0).all()


def test_diagnostics_say_the_state_and_its_reason(live: SimpleNamespace) -> None:
    said = live.reported
    array = decoded(topics.DIAGNOSTICS, live.heard[topics.DIAGNOSTICS][-1][1])
    tracking = array.status[0]
    assert tracking.name == "aquaflow: tracking"
    assert tracking.message == f"{said['state']}: {said['reason']}"
    values = {pair.key: pair.value for pair in tracking.values}
    assert values["unit"] == "map units"


def test_a_moment_of_the_map_has_only_what_was_asked_for(live: SimpleNamespace) -> None:
    mapper = live.dive.parts.maps.mappers[0]
    frame = live.dive.parts.slam.metric_frame(0)
    nothing = take_map_moment(mapper, 0, frame, points=False, pictures=False)
    assert nothing.rendered is None
    assert cloud_of(nothing, 100) is None
    some = take_map_moment(mapper, 0, frame, points=True, pictures=True)
    assert some.rendered is not None
    points = cloud_of(some, 100)
    assert points is not None
    assert 0 < len(points) <= 100


# --- the server by itself -------------------------------------------------------------------------


@pytest.fixture
def server() -> Iterator[FoxgloveServer]:
    server = FoxgloveServer(LOOPBACK, "test")
    yield server
    server.close()


def test_a_slow_client_loses_messages_and_no_other_does(
    server: FoxgloveServer, example: ModuleType
) -> None:
    address = f"ws://127.0.0.1:{server.port}"
    slow = connect(address, subprotocols=["foxglove.sdk.v1"], max_size=None)
    channels: list[Any] = []
    while not channels:
        said = json.loads(slow.recv(GIVE_UP_S))
        channels = said.get("channels", [])
    number = next(c["id"] for c in channels if c["topic"] == topics.CAMERA)
    wanted = [{"id": 1, "channelId": number}]
    slow.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
    until(lambda: server.is_wanted(topics.CAMERA))
    large = messages.jpeg(0, "x", np.zeros((8, 8, 3), np.uint8))
    large.data = np.zeros(4_000_000, np.uint8)
    count = 8 * BACKLOG
    for t_ns in range(count):  # 1 GB: neither the sockets nor the backlog hold it
        server.send(topics.CAMERA, t_ns, large)
    quick = Listener(example, server.port)
    until(lambda: server.is_wanted(topics.TF))
    small = messages.transforms(count, [])
    until(lambda: bool(quick.received[topics.TF]), lambda: server.send(topics.TF, count, small))
    quick.close()
    heard = []
    try:
        while True:
            received = slow.recv(1.0)
            heard.append(struct.unpack_from("<BIQ", received)[2])
    except TimeoutError:
        pass
    slow.close()
    assert heard == sorted(heard)
    assert heard[-1] == count - 1  # the newest came through
    assert len(heard) < count


def test_what_nobody_has_asked_for_is_not_encoded(
    server: FoxgloveServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []
    monkeypatch.setattr("aquaflow.live.foxglove.server.encode", asked.append)
    server.send(topics.CAMERA, 1, BIG)
    assert asked == []
    assert not server.is_wanted(topics.CAMERA)


def test_an_address_that_is_taken_is_one_sentence(server: FoxgloveServer) -> None:
    taken_port = LOOPBACK.model_copy(update={"port": server.port})
    with pytest.raises(InputError, match=rf"127.0.0.1:{server.port}: .* service\.foxglove\.port"):
        FoxgloveServer(taken_port, "second")


def test_it_is_off_and_on_loopback_unless_asked_for() -> None:
    assert not VehicleConfig().service.foxglove.enabled
    assert VehicleConfig().service.foxglove.host == "127.0.0.1"
    with pytest.raises(ValidationError, match="token_file"):
        FoxgloveConfig(enabled=True, host="0.0.0.0")


@pytest.mark.parametrize("module", ["websockets", "rosbags"])
def test_a_missing_package_is_named(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    there = importlib.util.find_spec

    def missing(name: str) -> object:
        return None if name == module else there(name)

    for place in ("aquaflow.live.foxglove.server", "aquaflow.dive.ros.topics"):
        monkeypatch.setattr(f"{place}.find_spec", missing)
    with pytest.raises(InputError, match=module):
        FoxgloveServer(LOOPBACK, "test")


def test_a_service_shows_its_dives_where_it_is_asked_to_and_stops_listening(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[FoxgloveServer] = []
    begin = FoxgloveServer.__init__

    def noted(self: FoxgloveServer, *arguments: Any) -> None:
        begin(self, *arguments)
        made.append(self)

    monkeypatch.setattr(FoxgloveServer, "__init__", noted)
    changed = VEHICLE.service.model_copy(update={"foxglove": LOOPBACK})
    loop = SimpleNamespace(watchers=[], dive_run=SimpleNamespace(deliverables={}))
    dive: Any = SimpleNamespace(parts=SimpleNamespace(loop=loop))
    for service, count in ((VEHICLE.service, 0), (changed, 1)):
        vehicle = VEHICLE.model_copy(update={"service": service})
        with (
            ServiceHealth(service) as vitals,
            ServiceFrontends(ToldFeed(), vehicle, ServiceControl(), vitals) as station,
        ):
            station.show(dive)
            station.hide()
        assert len(made) == count
    owners = [getattr(watch, "__self__", None) for watch in dive.parts.loop.watchers]
    assert sum(isinstance(owner, LiveFoxglove) for owner in owners) == 1
    with pytest.raises(OSError, match="refused"):
        connect(f"ws://127.0.0.1:{made[0].port}")


# --- the node of examples/ros2 --------------------------------------------------------------------


def test_the_example_node_hands_messages_on_byte_for_byte(
    example: ModuleType, server: FoxgloveServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a stand-in for rclpy: there is no ROS here."""
    published: dict[str, list[bytes]] = defaultdict(list)
    made: dict[str, tuple[str, str]] = {}

    def create_publisher(kind: str, topic: str, quality: SimpleNamespace) -> SimpleNamespace:
        made[topic] = (kind, quality.durability)
        return SimpleNamespace(publish=published[topic].append)

    policy = SimpleNamespace(TRANSIENT_LOCAL="transient local", VOLATILE="volatile")
    qos = SimpleNamespace(DurabilityPolicy=policy, QoSProfile=SimpleNamespace)
    monkeypatch.setitem(sys.modules, "rclpy", SimpleNamespace())
    monkeypatch.setitem(sys.modules, "rclpy.qos", qos)
    monkeypatch.setitem(sys.modules, "rosidl_runtime_py", SimpleNamespace())
    utilities = SimpleNamespace(get_message=lambda name: f"class of {name}")
    monkeypatch.setitem(sys.modules, "rosidl_runtime_py.utilities", utilities)
    connection = example.Connection(f"ws://127.0.0.1:{server.port}")
    node = SimpleNamespace(create_publisher=create_publisher)

    def run() -> None:
        with pytest.raises(Exception, match=r"."):  # the server goes away
            example.republish(connection, node)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    until(lambda: server.is_wanted(topics.TF_STATIC) and server.is_wanted(topics.CAMERA))
    static = messages.transforms(5, [])
    server.send(topics.TF_STATIC, 5, static)
    server.send(topics.CAMERA, 6, BIG)
    until(lambda: len(published) == 2)
    connection.close()
    thread.join(GIVE_UP_S)
    assert published == {topics.TF_STATIC: [encode(static)], topics.CAMERA: [encode(BIG)]}
    assert made == {
        topics.TF_STATIC: ("class of tf2_msgs/msg/TFMessage", "transient local"),
        topics.CAMERA: ("class of sensor_msgs/msg/CompressedImage", "volatile"),
    }
    assert set(example.LASTING) == set(topics.LASTING)


def test_the_waters_status_names_the_vehicles_lamps() -> None:
    three = torch.full((3,), 0.2)
    lamp = Lamp(0.8, 2.0, 1.5, 0.05, ((-0.2, -0.1), (0.2, -0.1)), (0.03, 0.02))
    for lit in (None, lamp):
        status = water_status(WaterParameters(*[three] * 5, lamp=lit), WorldFrame.unknown())
        values = {pair.key: pair.value for pair in status.values}
        named = [key for key in values if "lamp" in key]
        assert bool(named) is (lit is not None)
    assert values["lamps, share of the light at 1.5 map unit"] == "0.8"
    assert values["lamp 1 right of and below the camera, map unit"] == "-0.2, -0.1"
