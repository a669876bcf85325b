"""Bare RTP: what a BlueROV2 sends to UDP port 5600, by its port alone or by a description (SDP)."""

from __future__ import annotations

import base64
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from aquaflow.base.errors import InputError
from aquaflow.config.cameras import StreamConfig
from aquaflow.drivers.stream.session import session_of
from aquaflow.drivers.stream.udp_port import Port, bound, first_packet
from aquaflow.sim_drivers import rtp_camera as rtp_packets
from aquaflow.sim_drivers.camera_feed import CameraFaults, CameraFeed, Shot, first_images
from aquaflow.sim_drivers.h264_writer import units
from aquaflow.sim_drivers.rtp_camera import RtpCamera
from aquaflow.sim_drivers.transport_stream import UdpCamera
from aquaflow.types import Dropped, Frame
from tests.drivers.camera_scenes import (
    HEIGHT,
    WIDTH,
    Pictures,
    closing,
    feed,
    free_port,
    stream,
    until,
)


@contextmanager
def sent(port: int, *packets: bytes) -> Iterator[None]:
    """The same packets over and over."""
    ending = threading.Event()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not ending.wait(0.01):
                for packet in packets:
                    sender.sendto(packet, ("127.0.0.1", port))

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ending.set()
        thread.join()


def taken(port: int) -> socket.socket:
    """Another program on the port."""
    other = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    other.bind(("", port))
    return other


@pytest.mark.parametrize("address", ["udp://0.0.0.0:{}", "udp://192.168.2.1:{}", "rtp://@:{}"])
def test_a_port_is_enough_to_show_what_is_sent_to_it(address: str) -> None:
    """Also by the address of another computer, as BlueOS shows it: the stream is sent to here."""
    port = free_port()
    with RtpCamera(port, feed(), 98), closing(stream(address.format(port))) as camera:
        frame = next(camera.frames())
    assert isinstance(frame, Frame)
    assert frame.image.shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("where", ["file", "text"])
def test_a_session_description_is_followed(where: str, tmp_path: Path) -> None:
    port = free_port()
    text = rtp_packets.session(port)
    (tmp_path / "camera.sdp").write_text(text)
    url = text if where == "text" else str(tmp_path / "camera.sdp")
    with RtpCamera(port, feed()), closing(stream(url)) as camera:
        assert isinstance(next(camera.frames()), Frame)


def test_times_are_those_of_the_packets_not_those_of_their_arrival() -> None:
    """Filmed every 40 ms, sent in pairs."""

    class InPairs(CameraFeed):
        def wait(self, timeout_s: float) -> bool:
            shot = self.peek()
            late_s = 0.04 * (shot.sequence % 2 == 0)
            return super().wait(timeout_s) and self._now_ns() * 1e-9 > shot.due_ns * 1e-9 + late_s

    port = free_port()
    shots = InPairs(Pictures(), 25.0)
    with RtpCamera(port, shots), closing(stream(f"udp://127.0.0.1:{port}")) as camera:
        frames = camera.frames()
        times = {frame.index: frame.t_ns for frame in (next(frames) for _ in range(20))}
    steps = [(times[n + 1] - times[n]) * 1e-6 for n in sorted(times) if n + 1 in times]
    assert sorted(steps)[len(steps) // 2] == pytest.approx(40.0, abs=2.0)


def test_a_taken_port_is_one_sentence() -> None:
    port = free_port()
    with taken(port), pytest.raises(InputError) as caught:
        stream(f"udp://0.0.0.0:{port}").connect()
    assert str(caught.value) == (
        f"camera 'front': UDP port {port} is taken by another program or camera; let the camera "
        f"send to another port"
    )


def test_a_port_for_rtcp_is_needed_only_where_ffmpeg_reads() -> None:
    port = free_port()
    url = f"udp://0.0.0.0:{port}"
    with taken(port + 1), RtpCamera(port, feed()):
        with closing(stream(url)) as camera:
            camera.connect()
        with pytest.raises(InputError) as caught:
            stream(url, codec="h265").connect()
    said = f"UDP port {port + 1}, which port {port} needs beside it for RTCP, is taken by another"
    assert said in str(caught.value)


def test_a_silent_port_is_one_sentence() -> None:
    port = Port("0.0.0.0", free_port())
    with bound(port) as receiver, pytest.raises(ConnectionError) as caught:
        first_packet(receiver, port, wait_s=0.05)
    assert str(caught.value) == (
        f"no packet came to UDP port {port.number} within 0.05 s; the camera must send to "
        f"udp://ADDRESS-OF-THIS-COMPUTER:{port.number} (BlueOS: the stream's endpoint)"
    )


def test_reports_of_rtcp_are_no_media() -> None:
    port = Port("", free_port())
    report, media = bytes([0x80, 200]) + bytes(26), bytes([0x80, 96]) + bytes(20)
    with bound(port) as receiver, sent(port.number, report, media):
        assert first_packet(receiver, port) == media


def test_another_payload_type_is_one_sentence() -> None:
    port = free_port()
    with RtpCamera(port, feed(), 97):
        for settings in ({"url": f"udp://0.0.0.0:{port}", "payload_type": 96},
                         {"url": rtp_packets.session(port, 96)}):  # fmt: skip
            with pytest.raises(InputError) as caught:
                stream(**settings).connect()
            assert str(caught.value) == (
                f"camera 'front': packets on UDP port {port} have the RTP payload type 97, not 96; "
                f"change the payload type here, or in the camera"
            )


def test_what_is_neither_rtp_nor_mpeg_ts_is_one_sentence() -> None:
    port = free_port()
    with sent(port, b"hello, world"), pytest.raises(InputError, match="neither RTP nor MPEG-TS"):
        stream(f"udp://0.0.0.0:{port}").connect()


@pytest.mark.parametrize(
    ("codec", "problem"),
    [
        ("h264", "no key picture within 0.5 s; is its codec h264, and does it send key frames"),
        ("h265", "though packets come; is its codec h265, and does it send key frames"),
    ],
)
def test_rtp_that_makes_no_picture_says_what_may_be_wrong(
    codec: str, problem: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for reader in ("capture", "rtp_capture"):
        monkeypatch.setattr(f"aquaflow.drivers.stream.{reader}.OPEN_TIMEOUT_S", 0.5)
    port = free_port()
    with (
        sent(port, bytes([0x80, 96]) + bytes(50)),
        closing(stream(f"udp://0.0.0.0:{port}", codec=codec)) as camera,
    ):
        threading.Thread(target=lambda: list(camera.frames()), daemon=True).start()
        while problem not in camera.reason:
            assert not camera._closing.wait(0.01), f"gave up: {camera.reason}"


def test_rtp_of_another_kind_is_read_by_ffmpeg() -> None:
    """MPEG-TS in RTP: its payload type says what it is (RFC 3551)."""
    port = free_port()

    class InRtp(UdpCamera):
        number = 0

        def packet(self, datagram: bytes) -> bytes:
            self.number += 1
            ticks = round(self.number * self._period_s * 90_000)
            return struct.pack(">BBHII", 0x80, 33, self.number & 0xFFFF, ticks, 1) + datagram

    images = first_images(Pictures(), 40)
    with InRtp(port, images), closing(stream(f"udp://0.0.0.0:{port}")) as camera:
        frame = next(camera.frames())
    assert isinstance(frame, Frame)
    assert frame.image.shape == (HEIGHT, WIDTH, 3)


def test_a_picture_that_lost_packets_is_left_out_and_the_next_is_whole() -> None:
    port, shots = free_port(), feed(CameraFaults(corrupt=frozenset({30, 31})), 50.0)
    with RtpCamera(port, shots), closing(stream(f"udp://127.0.0.1:{port}")) as camera:
        seen = until(camera, 50)
    dropped = [frame for frame in seen if isinstance(frame, Dropped)]
    assert 0 < len(dropped) <= camera.counters.unusable <= 4
    assert all(frame.reason.endswith("lost packets on its way") for frame in dropped)
    assert isinstance(seen[-1], Frame)


@pytest.mark.parametrize(
    ("url", "problem"),
    [
        ("/nowhere/camera.sdp", "cannot read the session description /nowhere/camera.sdp"),
        ("v=0\r\nm=audio 5600 RTP/AVP 0\r\n", "holds no line 'm=video PORT RTP/AVP'"),
    ],
)
def test_a_description_that_is_none_is_one_sentence(url: str, problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        stream(url).connect()


def described(**settings: object) -> list[str]:
    """The lines of the description that FFmpeg gets."""
    asked = {"kind": "stream", **settings}
    made = session_of(StreamConfig.model_validate(asked)).data_url(98)
    return base64.b64decode(made.partition(",")[2]).decode().splitlines()


def test_a_description_is_made_from_the_port_and_the_codec() -> None:
    made = described(url="udp://0.0.0.0:5600", codec="h265")
    assert "m=video 5600 RTP/AVP 98" in made
    assert "a=rtpmap:98 H265/90000" in made
    assert "c=IN IP4 127.0.0.1" in made
    assert "c=IN IP4 239.1.2.3" in described(url="udp://239.1.2.3:5600")
    given = "v=0\r\nm=video 5600 RTP/AVP 98\r\na=rtpmap:98 H265/90000\r\n"
    assert described(url=given) == given.splitlines()


def test_what_a_description_says_of_its_codec_counts() -> None:
    """Parameters that are damaged come in the stream, too."""
    for name, sets, is_h264, parameters in [
        ("H264", "Z0LAFQ==,aM48gA==", True, (b"\x67\x42\xc0\x15", b"\x68\xce\x3c\x80")),
        ("H264", "Z0LAFQ", True, ()),
        ("H265", "", False, ()),
    ]:
        text = (
            f"v=0\r\nm=video 5600 RTP/AVP 97\r\na=rtpmap:97 {name}/90000\r\n"
            f"a=fmtp:97 packetization-mode=1; sprop-parameter-sets={sets}\r\n"
        )
        made = session_of(StreamConfig.model_validate({"kind": "stream", "url": text}))
        assert (made.is_h264(97), made.parameters) == (is_h264, parameters)


def test_a_stream_whose_description_holds_the_parameters_need_not_send_them() -> None:
    """As BlueOS's, which sends them every ten seconds."""

    class Sparing(RtpCamera):
        def _packets(self, shot: Shot) -> list[bytes]:
            return self._packetizer.packets(units(shot.image, shot.sequence)[2:], shot.true_ns)

    port, shots = free_port(), feed()
    sets = ",".join(base64.b64encode(each).decode() for each in units(shots.peek().image, 0)[:2])
    url = rtp_packets.session(port).replace("mode=1", f"mode=1;sprop-parameter-sets={sets}")
    with Sparing(port, shots), closing(stream(url)) as camera:
        assert isinstance(next(camera.frames()), Frame)


@pytest.mark.parametrize(
    ("address", "group"),
    [("239.1.2.3", "239.1.2.3"), ("192.168.2.1", None), ("vehicle.local", None), ("", None)],
)
def test_only_a_groups_address_is_joined(address: str, group: str | None) -> None:
    assert Port(address, 5600).group == group
