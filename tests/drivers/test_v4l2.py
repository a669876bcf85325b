"""The V4L2 driver against a simulated kernel: formats, controls, buffers, and who is who."""

from __future__ import annotations

import ctypes
import errno
import itertools
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.config.cameras import V4l2Config
from aquaflow.drivers.capture import UnusablePictureError
from aquaflow.drivers.v4l2 import V4l2Camera, abi
from aquaflow.drivers.v4l2 import abi as abi_planes
from aquaflow.drivers.v4l2.capture import V4l2Capture
from aquaflow.drivers.v4l2.discovery import camera_nodes, find_camera, modes
from aquaflow.drivers.v4l2.planes import PictureFormat, to_rgb
from aquaflow.sim_drivers.camera_feed import CameraFaults, first_images
from aquaflow.sim_drivers.v4l2_kernel import (
    EXPOSURE_ABSOLUTE,
    WHITE_BALANCE,
    CameraSpec,
    V4l2Kernel,
)
from aquaflow.sim_drivers.v4l2_multiplanar import MultiPlanarKernel
from aquaflow.types import Frame
from tests.drivers.camera_scenes import (
    HEIGHT,
    QUICK,
    WIDTH,
    Pictures,
    closing,
    feed,
    until,
    v4l2,
)


@pytest.mark.parametrize(
    ("structure", "size"),
    [
        (abi.Capability, 104), (abi.Format, 208), (abi.StreamParameters, 204),
        (abi.RequestBuffers, 20), (abi.Buffer, 88), (abi.V4l2Control, 8), (abi.QueryControl, 68),
        (abi.FormatDescription, 64), (abi.FrameSize, 44), (abi_planes.Plane, 64),
        (abi_planes.PlanePixFormat, 20), (abi_planes.PixFormatMplane, 192),
    ],
)  # fmt: skip
def test_structures_have_the_kernels_sizes(structure: type[ctypes.Structure], size: int) -> None:
    assert ctypes.sizeof(structure) == size


def test_request_numbers_are_the_kernels() -> None:
    assert abi.QUERYCAP == 0x80685600
    assert abi.S_FMT == 0xC0D05605
    assert abi.DQBUF == 0xC0585611
    assert abi.STREAMON == 0x40045612


def opened(
    root: Path,
    pixels: str = "YUYV",
    spec: CameraSpec | None = None,
    kernel_of: type[V4l2Kernel] = V4l2Kernel,
    **more: object,
):
    """An open capture and the kernel under it."""
    kernel = kernel_of(root, feed(), spec)
    config = V4l2Config.model_validate(
        {"kind": "v4l2", "pixels": pixels, "width": WIDTH, "height": HEIGHT, **more}
    )
    return V4l2Capture(kernel, str(root / "dev/video0"), config), kernel


@pytest.mark.parametrize("padding", [0, 32])
@pytest.mark.parametrize(
    ("pixels", "tolerance"),
    [("YUYV", 3), ("UYVY", 3), ("NV12", 3), ("NM12", 3), ("GREY", 1), ("MJPG", 4)],
)
@pytest.mark.parametrize("kernel_of", [V4l2Kernel, MultiPlanarKernel])
def test_pixels_become_those_that_were_filmed(
    tmp_path: Path, kernel_of: type[V4l2Kernel], pixels: str, tolerance: int, padding: int
) -> None:
    if pixels == "NM12" and kernel_of is V4l2Kernel:
        pytest.skip("two pieces of memory need the multi-planar API")
    spec = CameraSpec(padding=padding, pixels=(pixels,))
    capture, kernel = opened(tmp_path, pixels, spec, kernel_of)
    filmed = kernel.feed.peek().image.astype(int)
    picture = capture.read(1.0)
    assert picture is not None
    assert np.abs(picture.decode() - filmed).max() <= tolerance
    capture.close()


def test_a_camera_with_planes_is_found_and_films_through_all_that_happens(tmp_path: Path) -> None:
    shots = feed(CameraFaults(disconnect=frozenset({8}), away_s=0.05))
    kernel = MultiPlanarKernel(tmp_path, shots, CameraSpec(pixels=("NM12",), interrupts=20))
    (node,) = camera_nodes(kernel, tmp_path)
    assert modes(kernel, node.path) == ["NM12 up to 64 x 48"]
    size = {"width": WIDTH, "height": HEIGHT}
    config = V4l2Config.model_validate({"kind": "v4l2", "pixels": "NV12", **size, **QUICK})
    with closing(V4l2Camera("front", config, kernel, tmp_path)) as camera:
        seen = until(camera, 15)
    assert all(isinstance(frame, Frame) for frame in seen)
    assert camera.notes == ["the camera gives 64 x 48 NM12 where 64 x 48 NV12 was asked for"]
    assert camera.counters.reconnects == 1


def test_h264_is_decoded_picture_by_picture_with_the_kernels_times(tmp_path: Path) -> None:
    shots = feed(CameraFaults(corrupt=frozenset({4}), drop=frozenset({6})), fps=50.0)
    with closing(v4l2(shots, tmp_path, "H264")[0]) as camera:
        seen = until(camera, 12)
    filmed = [image.astype(int) for image in first_images(Pictures(), 40)]
    shown = [frame for frame in seen if isinstance(frame, Frame)]
    assert len(shown) > 5
    for frame in shown:
        assert np.abs(frame.image.astype(int) - filmed[frame.index]).max() <= 4
        assert frame.encoded is None
    steps = np.diff([frame.t_ns for frame in shown]) / np.diff([frame.index for frame in shown])
    assert steps == pytest.approx(20e6, abs=2e3)
    assert camera.counters.lost == 1


def test_h264_that_stops_is_a_silent_camera(tmp_path: Path) -> None:
    shots = feed(CameraFaults(delay_s={5: 1e6}))
    with closing(v4l2(shots, tmp_path, "H264", stall_s=0.3)[0]) as camera:
        frames = camera.frames()
        next(frames)
        while "no picture for 0.3 s" not in camera.reason:
            assert not camera._closing.wait(0.01), "gave up"


def test_jpeg_comes_with_its_bytes_and_pixels_do_not(tmp_path: Path) -> None:
    for number, pixels in enumerate(("MJPG", "YUYV")):
        with closing(v4l2(feed(), tmp_path / str(number), pixels)[0]) as camera:
            frame = next(camera.frames())
        assert isinstance(frame, Frame)
        assert (frame.encoded is not None) == (pixels == "MJPG")
        if frame.encoded is not None:
            assert frame.encoded.format == "jpeg"
            assert frame.encoded.data.startswith(b"\xff\xd8")


def test_pictures_are_views_of_the_kernels_memory(tmp_path: Path) -> None:
    capture, kernel = opened(tmp_path)
    picture = capture.read(1.0)
    assert picture is not None
    kernel._buffers.memory[0][:] = 128  # nobody copied it yet
    assert np.ptp(picture.decode()) == 0
    capture.close()


def test_a_buffer_is_the_kernels_again_only_after_its_release(tmp_path: Path) -> None:
    capture, _ = opened(tmp_path)
    held = [capture.read(1.0) for _ in range(4)]
    assert all(held)
    assert capture.read(0.05) is None
    held[2].release()
    assert capture.read(1.0) is not None
    capture.close()


def test_a_picture_outlives_the_device(tmp_path: Path) -> None:
    capture, _ = opened(tmp_path)
    picture = capture.read(1.0)
    assert picture is not None
    capture.close()
    capture.close()
    assert picture.decode().shape == (HEIGHT, WIDTH, 3)
    picture.release()


def test_what_the_driver_made_of_the_format_is_used_and_told(tmp_path: Path) -> None:
    camera, _ = v4l2(feed(), tmp_path, "MJPG", CameraSpec(pixels=("YUYV",)), width=1280)
    with closing(camera):
        frame = next(camera.frames())
        assert isinstance(frame, Frame)
        assert frame.image.shape == (HEIGHT, WIDTH, 3)
    assert camera.notes == ["the camera gives 64 x 48 YUYV where 1280 x 48 MJPG was asked for"]


def test_another_rate_than_asked_for_is_told(tmp_path: Path) -> None:
    with closing(v4l2(feed(), tmp_path, fps=15)[0]) as camera:
        next(camera.frames())
    assert camera.notes == ["the camera gives 30 pictures/s where 15 were asked for"]


def test_signals_interrupt_nothing(tmp_path: Path) -> None:
    with closing(v4l2(feed(), tmp_path, spec=CameraSpec(interrupts=50))[0]) as camera:
        assert until(camera, 5)


def test_controls_are_set_within_their_range_and_read_back(tmp_path: Path) -> None:
    wanted = {"exposure_s": 0.008, "white_balance_k": 15_000, "gain": 10}
    with closing(v4l2(feed(), tmp_path, **wanted)[0]) as camera:
        frame = next(camera.frames())
        assert isinstance(frame, Frame)
        assert frame.exposure_s == pytest.approx(0.008)
        assert frame.gain is None
        assert camera.notes == ["the camera has no fixed gain; it decides for itself"]
        kernel = camera._system
        assert isinstance(kernel, V4l2Kernel)
        assert kernel.controls[EXPOSURE_ABSOLUTE] == 80
        assert kernel.controls[WHITE_BALANCE] == 10_000


def test_a_camera_without_controls_still_films(tmp_path: Path) -> None:
    spec = CameraSpec(controls=())
    with closing(v4l2(feed(), tmp_path, spec=spec, exposure_s=0.01)[0]) as camera:
        frame = next(camera.frames())
        assert isinstance(frame, Frame)
        assert frame.exposure_s is None
        assert "no fixed exposure" in camera.notes[0]


def test_only_the_node_that_films_is_a_camera(tmp_path: Path) -> None:
    kernel = V4l2Kernel(tmp_path, feed())
    assert (tmp_path / "dev/video1").exists()
    (node,) = camera_nodes(kernel, tmp_path)
    assert node.path == tmp_path / "dev/video0"
    assert node.ids == ("usb-SIM0001-video-index0", "SIM0001", "usb-0000:00:14.0-1")
    assert modes(kernel, node.path)[0] == "YUYV up to 64 x 48"


@pytest.mark.parametrize(
    "device", [None, "usb-SIM0001-video-index0", "SIM0001", "usb-0000:00:14.0-1"]
)
def test_a_camera_is_found_by_each_of_its_ids(tmp_path: Path, device: str | None) -> None:
    assert find_camera(V4l2Kernel(tmp_path, feed()), device, tmp_path).name.startswith("Simulated")


@pytest.mark.parametrize("device", ["video0", "/dev/video0", "SIM0002"])
def test_another_id_is_refused_with_those_that_are_there(tmp_path: Path, device: str) -> None:
    camera, _ = v4l2(feed(), tmp_path, device=device)
    with pytest.raises(InputError, match=r"'front': no camera '.*; .*: usb-SIM0001-video-index0"):
        camera.connect()


def test_two_cameras_need_an_id(tmp_path: Path) -> None:
    first = V4l2Kernel(tmp_path, feed())
    other = tmp_path / "dev/video7"
    other.touch()

    class Two:
        """The first kernel, with a second camera plugged into another port."""

        def __getattr__(self, name: str) -> object:
            return getattr(first, name)

        def open(self, path: str) -> int:
            first.spec.bus = "usb-2" if path == str(other) else "usb-1"
            fd = first.open(path)
            first._descriptors[fd] = "video0" if path == str(other) else first._descriptors[fd]
            return fd

    with pytest.raises(OSError, match="several cameras fit; set device to one of usb-SIM0001"):
        find_camera(Two(), None, tmp_path)  # type: ignore[arg-type]
    assert find_camera(Two(), "usb-2", tmp_path).path == other  # type: ignore[arg-type]


def test_a_camera_in_use_says_by_whom_it_may_be(tmp_path: Path) -> None:
    kernel = V4l2Kernel(tmp_path, feed())
    config = V4l2Config(kind="v4l2")
    V4l2Capture(kernel, str(tmp_path / "dev/video0"), config)
    second, _ = v4l2(feed(), tmp_path / "other")
    second._system, second._root = kernel, tmp_path
    with pytest.raises(InputError, match="another program has it"):
        second.connect()


def test_a_replugged_camera_is_found_under_its_new_number(tmp_path: Path) -> None:
    shots = feed(CameraFaults(disconnect=frozenset({3}), away_s=0.05))
    with closing(v4l2(shots, tmp_path, device="SIM0001")[0]) as camera:
        until(camera, 6)
    assert [path.name for path in sorted((tmp_path / "dev").glob("video*"))] == ["video2", "video3"]


def until_step(ioctl: Callable[..., None], calls: Iterator[int], step: int, *call: Any) -> None:
    """An ioctl of a device that is unplugged at the ``step``-th call."""
    if next(calls) >= step:
        raise OSError(errno.ENODEV, "No such device")
    ioctl(*call)


def test_every_step_of_opening_survives_the_unplugging(tmp_path: Path) -> None:
    config = V4l2Config(kind="v4l2", exposure_s=0.01)
    calls = itertools.count()

    def opened_until(step: int) -> tuple[V4l2Kernel, Callable[[], V4l2Capture]]:
        root = tmp_path / str(step)
        kernel = V4l2Kernel(root, feed())
        kernel.ioctl = partial(until_step, kernel.ioctl, calls, step)  # type: ignore[method-assign]
        return kernel, lambda: V4l2Capture(kernel, str(root / "dev/video0"), config)

    opened_until(1_000)[1]()
    needed = next(calls)
    assert needed > 12
    for step in range(needed):
        calls = itertools.count()
        kernel, opening = opened_until(step)
        with pytest.raises(OSError, match="No such device"):
            opening()
        assert not kernel._descriptors, "a descriptor was left open"


@pytest.mark.parametrize(
    ("data", "pixels", "problem"),
    [
        (b"\xff\xd8 but then no picture", "MJPG", "damaged JPEG"),
        (b"", "MJPG", "no JPEG"),
        (b"\0" * 100, "YUYV", "cut off after 100 of"),
        (b"\0" * 100, "NV12", "cut off after 100 of"),
        (b"\0" * 9999, "BA81", "of type BA81"),
    ],
)
def test_bytes_that_make_no_picture_are_refused(data: bytes, pixels: str, problem: str) -> None:
    with pytest.raises(UnusablePictureError, match=problem):
        to_rgb([np.frombuffer(data, np.uint8)], PictureFormat(pixels, WIDTH, HEIGHT, (2 * WIDTH,)))


def test_a_jpeg_of_another_size_is_refused() -> None:
    import cv2

    _, jpeg = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(UnusablePictureError, match="8 x 8 px where the camera announced 64 x 48"):
        to_rgb([jpeg], PictureFormat("MJPG", WIDTH, HEIGHT, (0,)))
