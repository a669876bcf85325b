"""Network streams: HTTP, RTSP and MPEG-TS over UDP from servers on this computer."""

from __future__ import annotations

import logging
import os
import socket
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.drivers import ffmpeg
from aquaflow.drivers.live import CameraState
from aquaflow.drivers.stream.session import for_logs
from aquaflow.sim_drivers import mjpeg_server
from aquaflow.sim_drivers.camera_feed import CameraFeed, Shot, first_images
from aquaflow.sim_drivers.mjpeg_server import MjpegServer
from aquaflow.sim_drivers.rtp_camera import RtspCamera
from aquaflow.sim_drivers.transport_stream import UdpCamera
from aquaflow.types import Frame
from tests.drivers.camera_scenes import (
    COUNT,
    HEIGHT,
    WIDTH,
    Pictures,
    closing,
    feed,
    free_port,
    settled,
    stream,
    until,
)


def nobody() -> int:
    """A TCP port on which nobody listens."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_mpeg_ts_is_recognised_and_comes_back_when_it_broke() -> None:
    """Its time begins anew with every round of the recording."""
    port = free_port()
    server = UdpCamera(port, first_images(Pictures(), COUNT))
    with server, closing(stream(f"udp://127.0.0.1:{port}", stall_s=0.5)) as camera:
        frames = camera.frames()
        first = next(frames)
        assert isinstance(first, Frame)
        assert first.image.shape == (HEIGHT, WIDTH, 3)
        server.plugged_in.clear()
        while camera.state is not CameraState.LOST:
            assert not camera._closing.wait(0.02), "gave up"
        server.plugged_in.set()
        while camera.counters.reconnects == 0:
            next(frames)
    assert settled(camera)


@pytest.mark.parametrize("transport", ["tcp", "udp"])
def test_rtsp_is_shown_and_comes_back_when_it_broke(transport: str) -> None:
    shots = feed(fps=50.0)
    server = RtspCamera(shots)
    with server, closing(stream(server.url, transport=transport, stall_s=0.5)) as camera:
        frames = camera.frames()
        first = next(frames)
        assert isinstance(first, Frame)
        assert first.image.shape == (HEIGHT, WIDTH, 3)
        server.sending.clear()
        while camera.state is not CameraState.LOST:
            assert not camera._closing.wait(0.02), "gave up"
        server.sending.set()
        while camera.counters.reconnects == 0:
            next(frames)
    assert settled(camera)
    assert server.clients >= 2  # on a busy machine a try may end before pictures come again


def test_a_picture_is_stamped_when_it_arrives_less_the_latency() -> None:
    with MjpegServer(feed()) as server, closing(stream(server.url, latency_s=0.25)) as camera:
        seen = until(camera, 5)
    for frame in seen[1:]:
        assert isinstance(frame, Frame)
        assert frame.arrival_ns - frame.t_ns == 250_000_000
    assert camera.counters.stamps_repaired == 0


def test_nobody_there_is_one_sentence_without_the_password() -> None:
    port = nobody()
    with pytest.raises(InputError) as caught:
        stream(f"http://pilot:secret@127.0.0.1:{port}/video").connect()
    assert str(caught.value) == f"camera 'front': no video from http://127.0.0.1:{port}/video"


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("rtsp://user:pass@10.0.0.5:554/a?b=1", "rtsp://10.0.0.5:554/a?b=1"),
        ("rtsp://user@host/a", "rtsp://host/a"),
        ("udp://0.0.0.0:5600", "udp://0.0.0.0:5600"),
        ("/etc/camera.sdp", "/etc/camera.sdp"),
        ("v=0\r\nm=video 5600 RTP/AVP 96\r\n", "the session description"),
    ],
)
def test_passwords_are_not_shown(url: str, shown: str) -> None:
    assert for_logs(url) == shown


def test_what_is_no_video_is_refused() -> None:
    refusing = socket.create_server(("127.0.0.1", 0))

    def answer() -> None:
        client, _ = refusing.accept()
        with client:
            client.recv(1000)
            client.sendall(b"HTTP/1.0 200 OK\r\nContent-Type: text/html\r\n\r\n<p>hello</p>")

    thread = threading.Thread(target=answer, daemon=True)
    thread.start()
    with refusing, pytest.raises(InputError, match="no video from"):
        stream(f"http://127.0.0.1:{refusing.getsockname()[1]}/").connect()


def test_options_of_ffmpeg_are_given_back(monkeypatch: pytest.MonkeyPatch) -> None:
    port = nobody()
    for before in (None, "hwaccel;none"):
        if before is not None:
            monkeypatch.setenv(ffmpeg.OPTIONS, before)
        with pytest.raises(InputError):
            stream(f"http://127.0.0.1:{port}/").connect()
        assert os.environ.get(ffmpeg.OPTIONS) == before


def test_nothing_is_written_to_stderr(
    capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    shots = CameraFeed(Pictures(), 100.0)
    with caplog.at_level(logging.WARNING), MjpegServer(shots) as server:
        camera = stream(server.url, stall_s=0.2, last_retry_s=0.02)
        with closing(camera):
            next(camera.frames())
            server.ending.set()
            while not camera.reason:
                camera._closing.wait(0.02)
    assert capfd.readouterr().err == ""
    assert "camera 'front' is lost" in caplog.text
    assert np.all([record.levelno == logging.WARNING for record in caplog.records])


def test_a_motion_jpeg_picture_is_kept_byte_by_byte(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: set[bytes] = set()
    made = mjpeg_server._jpeg

    def remembered(shot: Shot) -> bytes:
        jpeg = made(shot)
        sent.add(jpeg)
        return jpeg

    monkeypatch.setattr(mjpeg_server, "_jpeg", remembered)
    with MjpegServer(feed()) as server, closing(stream(server.url)) as camera:
        seen = [frame for frame in until(camera, 5) if isinstance(frame, Frame)]
    assert seen
    for frame in seen:
        assert frame.encoded is not None
        assert frame.encoded.data in sent
        decoded = cv2.imdecode(np.frombuffer(frame.encoded.data, np.uint8), cv2.IMREAD_COLOR_RGB)
        assert np.array_equal(frame.image, decoded)
