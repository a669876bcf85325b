"""A dive as MCAP, read back by Foxglove's reader of ROS 2 messages, which is not ours."""

from __future__ import annotations

import io
import json
import shutil
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from PIL import Image
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from aquaflow.base.errors import InputError
from aquaflow.base.errors.crash_report import MISUSED
from aquaflow.dive import point_cloud
from aquaflow.dive.dive import Dive, read_dive
from aquaflow.dive.point_cloud import read_point_cloud, read_posed_views
from aquaflow.dive.restored import restored_frames, tone_without_water
from aquaflow.dive.ros import messages as ros_messages
from aquaflow.dive.ros.topics import LASTING, TYPES
from aquaflow.survey.export.mcap_export import export_mcap
from aquaflow.water.mounting import Lamp
from tests.command_line import Cli, refused
from tests.dive.ros.published import HASHES, hash_of

Array = npt.NDArray[np.float64]
Messages = dict[str, list["Read"]]
LOST_IN_JPEG = 1.0
"""Of 255; mean difference of the means of 8 x 8 noisy pixels."""
START_NS = 1_800_000_000_250_000_000
START_UTC = "2027-01-15T08:00:00.250000Z"


@dataclass(frozen=True)
class Read:
    """A message as the reader gives it."""

    topic: str
    log_time_ns: int
    publish_time_ns: int
    ros_msg: Any


def read_all(path: Path) -> Iterator[Read]:
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            yield Read(channel.topic, message.log_time, message.publish_time, decoded)


@pytest.fixture(scope="module")
def dive(small_dive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small dive with a UTC, a frame that was lost, and a warning."""
    folder = tmp_path_factory.mktemp("mcap") / "dive"
    shutil.copytree(small_dive, folder)
    metrics = json.loads((folder / "metrics.json").read_text())
    metrics |= {"utc_start": START_UTC, "warnings": ["something is poor"]}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    medium = json.loads((folder / "medium.json").read_text())
    (folder / "medium.json").write_text(json.dumps(medium | {"lamp": asdict(LAMP)}))
    with (folder / "frames.csv").open("a") as table:
        table.write("24,000024.png,2.400000000,lost,,,,too few matches\n")
    return folder


LAMP = Lamp(0.8, 2.0, 1.5, 0.05, ((-0.2, -0.1), (0.2, -0.1)), (0.03, 0.02))


@pytest.fixture(scope="module")
def exported(dive: Path, small_recording: Path) -> Path:
    path = dive / "dive.mcap"
    export_mcap(Dive(dive), path, small_recording)
    return path


@pytest.fixture(scope="module")
def messages(exported: Path) -> Messages:
    found: Messages = defaultdict(list)
    for read in read_all(exported):
        found[read.topic].append(read)
    return found


def stamp_ns(header: Any) -> int:
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def matrix(translation: Any, rotation: Any) -> Array:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([rotation.x, rotation.y, rotation.z, rotation.w]).as_matrix()
    T[:3, 3] = translation.x, translation.y, translation.z
    return T


def blocks(picture: npt.NDArray[Any]) -> Array:
    """Means over 8 x 8 pixels: JPEG takes some of the noise of single ones."""
    height, width, _ = picture.shape
    return np.asarray(picture.reshape(height // 8, 8, width // 8, 8, 3).mean(axis=(1, 3)), float)


def camera_to_map(messages: Messages) -> Iterator[tuple[int, Array]]:
    """At each moment of /tf, by following the links from the pictures' frame to the map."""
    parents = {}
    for link in messages["/tf_static"][0].ros_msg.transforms:
        parents[link.child_frame_id] = (
            link.header.frame_id, matrix(link.transform.translation, link.transform.rotation)
        )  # fmt: skip
    for read in messages["/tf"]:
        (moved,) = read.ros_msg.transforms
        T, frame = np.eye(4), "camera_optical"
        while frame != moved.child_frame_id:
            frame, step = parents[frame]
            T = step @ T
        assert moved.header.frame_id == "map"
        yield (
            stamp_ns(moved.header),
            matrix(moved.transform.translation, moved.transform.rotation) @ T,
        )


def test_every_definition_has_the_hash_that_ros_publishes_for_its_type(exported: Path) -> None:
    with exported.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    schemas = {schema.name: schema for schema in summary.schemas.values()}
    assert set(schemas) == set(HASHES) - {"sensor_msgs/msg/NavSatFix"}  # the dive has no origin
    for name, schema in schemas.items():
        assert schema.encoding == "ros2msg"
        assert hash_of(name, schema.data.decode()) == HASHES[name]
    for channel in summary.channels.values():
        assert channel.message_encoding == "cdr"
        assert summary.schemas[channel.schema_id].name == TYPES[channel.topic]
        lasting = "durability: 1" in channel.metadata["offered_qos_profiles"]
        assert lasting == (channel.topic in LASTING)


def test_all_types_of_topics_have_a_published_hash() -> None:
    assert set(TYPES.values()) == set(HASHES)


def test_messages_bear_the_dives_own_times_in_utc(messages: Messages, dive: Path) -> None:
    times = [START_NS + round(row.t_s * 1e9) for row in read_dive(dive).frames]
    of_tracking = [m for m in messages["/diagnostics"] if m.ros_msg.status[0].name.endswith("ing")]
    assert [stamp_ns(m.ros_msg.header) for m in of_tracking] == times
    for topic in ("/tf", "/aquaflow/pose", "/camera/image/compressed", "/camera/camera_info"):
        for read in messages[topic]:
            inner = read.ros_msg.transforms[0] if topic == "/tf" else read.ros_msg
            assert stamp_ns(inner.header) == read.log_time_ns == read.publish_time_ns
            assert read.log_time_ns in times


def test_frames_compose_to_the_pose_of_each_picture(messages: Messages, dive: Path) -> None:
    where = read_posed_views(Dive(dive), Dive(dive).views())[1]
    trajectory = read_dive(dive).trajectory
    T_un = where.T_un.matrix
    found = list(camera_to_map(messages))
    assert len(found) == len(trajectory) > 20
    for (t_ns, T_mo), t_s, R, centre in zip(
        found, trajectory.t_s, trajectory.R_wc, trajectory.positions, strict=True
    ):
        assert t_ns == START_NS + round(t_s * 1e9)
        np.testing.assert_allclose(T_mo[:3, :3], T_un[:3, :3] @ R, atol=1e-8)
        np.testing.assert_allclose(T_mo[:3, 3], T_un[:3, :3] @ centre, atol=1e-8)
    # REP-103: the camera's body looks along x, with y to the left and z up.
    at_camera = next(
        link
        for link in messages["/tf_static"][0].ros_msg.transforms
        if link.child_frame_id == "camera_optical"
    )
    turned = matrix(at_camera.transform.translation, at_camera.transform.rotation)
    np.testing.assert_allclose(turned[:3, :3] @ [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(turned[:3, :3] @ [1.0, 0.0, 0.0], [0.0, -1.0, 0.0], atol=1e-12)


def test_a_point_of_the_cloud_lies_where_a_picture_shows_it(messages: Messages, dive: Path) -> None:
    cloud = messages["/aquaflow/points"][0].ros_msg
    assert cloud.header.frame_id == "map"
    names = [field.name for field in cloud.fields]
    kind = np.dtype([(name, "<f4") for name in names])
    assert cloud.point_step == kind.itemsize
    points = np.frombuffer(bytes(cloud.data), kind)
    given = read_point_cloud(Dive(dive))
    assert len(points) == cloud.width == len(given)
    (chunk,) = given.chunks()
    np.testing.assert_allclose(points["z"], chunk.positions[:, 2], rtol=1e-6)
    np.testing.assert_allclose(points["sigma"], chunk.sigma, rtol=1e-6)
    colours = points["rgb"].view("<u4")
    np.testing.assert_array_equal(colours >> 16 & 255, chunk.colours[:, 0])
    np.testing.assert_array_equal(colours & 255, chunk.colours[:, 2])

    info = messages["/camera/camera_info"][0]
    poses = dict(camera_to_map(messages))
    T_om = np.linalg.inv(poses[stamp_ns(info.ros_msg.header)])
    ours = read_posed_views(Dive(dive), Dive(dive).views())[0][0]
    places = np.stack([points["x"], points["y"], points["z"], np.ones(len(points))]).astype(float)
    in_camera = (T_om @ places)[:3]
    pixels = (np.array(info.ros_msg.k).reshape(3, 3) @ in_camera)[:2] / in_camera[2]
    expected = ours.camera.project(ours.T_uc.inverse().apply(chunk.positions))
    seen = ours.shows(ours.T_uc.inverse().apply(chunk.positions))
    assert seen.sum() > 100
    # ROS's first pixel has its centre at zero, ours at a half.
    np.testing.assert_allclose(pixels.T[seen] + 0.5, expected[seen], atol=0.05)


def test_of_more_points_than_a_message_takes_every_third_is_in_it(
    dive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cloud = read_point_cloud(Dive(dive))
    whole = ros_messages.packed_points(cloud)
    monkeypatch.setattr(ros_messages, "MOST_POINTS", len(whole) // 3 + 1)
    monkeypatch.setattr(point_cloud, "CHUNK", 100)
    assert ros_messages.points_step(cloud) == 3
    np.testing.assert_array_equal(ros_messages.packed_points(cloud), whole[::3])


def test_pictures_are_those_of_the_camera_the_map_and_the_restoration(
    messages: Messages, dive: Path, small_recording: Path
) -> None:
    mapper = Dive(dive).map()
    tone = tone_without_water(Dive(dive), mapper)
    restored = [
        picture.picture_bytes(tone)
        for _, picture in restored_frames(Dive(dive), mapper, small_recording)
    ]
    found = messages["/camera/restored/compressed"]
    assert len(found) == len(restored) == len(messages["/camera/rendered/compressed"])
    for read, expected in zip(found, restored, strict=True):
        assert read.ros_msg.format == "jpeg"
        assert read.ros_msg.header.frame_id == "camera_optical"
        picture = np.asarray(Image.open(io.BytesIO(bytes(read.ros_msg.data))), float)
        assert np.abs(blocks(picture) - blocks(expected)).mean() < LOST_IN_JPEG
    first = np.asarray(Image.open(io.BytesIO(messages["/camera/image/compressed"][0].ros_msg.data)))
    recorded = np.asarray(Image.open(sorted((small_recording / "images").iterdir())[0]))
    assert np.abs(blocks(first) - blocks(recorded)).mean() < LOST_IN_JPEG


def test_poses_state_their_sigma_and_plots_their_numbers(messages: Messages, dive: Path) -> None:
    rows = read_dive(dive).navigation()
    for read, row in zip(messages["/aquaflow/pose"], rows, strict=True):
        covariance = np.array(read.ros_msg.pose.covariance).reshape(6, 6)
        assert row.sigma_position_m is not None
        assert row.sigma_heading_deg is not None
        assert covariance[0, 0] == pytest.approx(row.sigma_position_m**2)
        assert covariance[5, 5] == pytest.approx(np.radians(row.sigma_heading_deg) ** 2)
    columns = {"depth_m", "altitude_m", "heading_deg", "speed_m_s"}
    for column in columns:
        said = [read.ros_msg.data for read in messages[f"/aquaflow/{column}"]]
        assert said == [v for row in rows if (v := getattr(row, column)) is not None]


def test_diagnostics_state_water_warnings_and_lost_frames(messages: Messages, dive: Path) -> None:
    of_dive, water = messages["/diagnostics"][0].ros_msg.status
    assert (int(of_dive.level), of_dive.message) == (1, "something is poor")
    stated = json.loads((dive / "medium.json").read_text())
    values = {pair.key: pair.value for pair in water.values}
    red = values[f"attenuation red, {stated['attenuation_unit']}"]
    assert float(red) == pytest.approx(stated["attenuation_per_unit"][0], rel=1e-5)
    (share,) = (value for key, value in values.items() if "share of the light at 1.5 " in key)
    assert float(share) == LAMP.share
    (place,) = (value for key, value in values.items() if key.startswith("lamp 2 right of"))
    assert place == "0.2, -0.1"
    last = messages["/diagnostics"][-1].ros_msg.status[0]
    assert (int(last.level), last.message) == (1, "lost: too few matches")


def test_the_whole_path_is_there_from_the_beginning(messages: Messages) -> None:
    (path,) = messages["/aquaflow/path"]
    assert path.log_time_ns == START_NS
    poses = [m.ros_msg for m in messages["/aquaflow/pose"]]
    assert len(path.ros_msg.poses) == len(poses)
    for stamped, posed in zip(path.ros_msg.poses, poses, strict=True):
        assert stamp_ns(stamped.header) == stamp_ns(posed.header)
        assert stamped.pose.position.x == posed.pose.pose.position.x


def test_a_second_reader_has_the_same_messages(exported: Path, messages: Messages) -> None:
    found: dict[str, int] = defaultdict(int)
    with AnyReader([exported]) as reader:
        for connection, t_ns, data in reader.messages():
            theirs = reader.deserialize(data, connection.msgtype)
            if connection.topic == "/aquaflow/pose":
                ours = messages[connection.topic][found[connection.topic]]
                assert t_ns == ours.log_time_ns
                assert theirs.pose.pose.position.x == ours.ros_msg.pose.pose.position.x
            found[connection.topic] += 1
    assert found == {topic: len(reads) for topic, reads in messages.items()}


def test_the_layout_shows_only_topics_that_are_in_the_file(
    exported: Path, messages: Messages
) -> None:
    layout = json.loads(exported.with_suffix(".layout.json").read_text())
    panels = layout["configById"]
    images = [p["imageMode"]["imageTopic"] for n, p in panels.items() if n.startswith("Image!")]
    assert images == ["/camera/image/compressed", "/camera/restored/compressed"]
    plotted = [line["value"] for p in panels.values() for line in p.get("paths", [])]
    assert all(value.removesuffix(".data") in messages for value in plotted)
    assert set(panels["3D!map"]["topics"]) <= set(messages)

    def leaves(node: Any) -> list[str]:
        return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])

    assert sorted(leaves(layout["layout"])) == sorted(panels)


def test_without_a_recording_the_map_is_drawn(small_dive: Path, tmp_path: Path) -> None:
    wrote = export_mcap(Dive(small_dive), tmp_path / "dive.mcap")
    topics = {read.topic for read in read_all(tmp_path / "dive.mcap")}
    assert "/camera/image/compressed" not in topics
    assert {"/camera/rendered/compressed", "/camera/restored/compressed"} <= topics
    assert wrote.times.startswith("seconds since")
    first = next(read_all(tmp_path / "dive.mcap"))
    assert first.log_time_ns == 0


def test_the_same_dive_gives_the_same_bytes(
    exported: Path, dive: Path, small_recording: Path, tmp_path: Path
) -> None:
    export_mcap(Dive(dive), tmp_path / "again.mcap", small_recording)
    assert (tmp_path / "again.mcap").read_bytes() == exported.read_bytes()


def test_another_recording_leaves_no_file(dive: Path, pictures: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no readable frame"):
        export_mcap(Dive(dive), tmp_path / "dive.mcap", pictures)
    assert list(tmp_path.glob("*.mcap*")) == list(tmp_path.glob(".*.part")) == []


def test_the_command_says_what_lengths_and_times_are(
    command: Cli, small_dive: Path, tmp_path: Path
) -> None:
    out = tmp_path / "dive.mcap"
    ran = command("export", small_dive, "--format", "mcap", "--out", out, "--json")
    assert ran.code == 0, ran.err
    said = json.loads(ran.out)
    assert said["out"] == str(out)
    assert said["unit"] == "m"
    assert Path(said["layout"]).is_file()
    refused(command("export", small_dive, "--format", "mcap", "--water"), "--water", code=MISUSED)
