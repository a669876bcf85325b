"""Which cameras the kernel has, and which of them is the one that the config means.

The number in ``/dev/videoN`` changes when a camera is plugged in again; its ids do not.
"""

from __future__ import annotations

import errno
import re
from dataclasses import dataclass
from pathlib import Path

from aquaflow.drivers.v4l2 import abi
from aquaflow.drivers.v4l2.planes import layout_of
from aquaflow.drivers.v4l2.system import KernelInterface, call, supports

TAKES_PICTURES = abi.CAP_VIDEO_CAPTURE | abi.CAP_VIDEO_CAPTURE_MPLANE
"""In one piece or in several; codecs, which turn pictures into pictures, say otherwise."""


@dataclass(frozen=True)
class CameraNode:
    """A node that takes pictures and streams them; one camera may have several."""

    path: Path
    name: str
    bus: str
    """Where it is plugged in: equal for all nodes of one camera."""
    ids: tuple[str, ...]
    """What a config may call it, the most stable first."""


def camera_nodes(system: KernelInterface, root: Path = Path("/")) -> list[CameraNode]:
    """Every camera below ``root``, by number; those that may not be opened are left out."""
    found = []
    for path in sorted(root.glob("dev/video*"), key=_number):
        capability = _capability(system, path)
        if capability is not None:
            bus = capability.bus_info.decode(errors="replace")
            ids = (*_links(root, path), *_usb_serial(root, path), bus)
            found.append(CameraNode(path, capability.card.decode(errors="replace"), bus, ids))
    return found


def find_camera(system: KernelInterface, device: str | None, root: Path = Path("/")) -> CameraNode:
    """The first node of the camera with the id ``device``, or of the only camera.

    Raises:
        FileNotFoundError: it is not there.
        OSError: several cameras fit.
    """
    nodes = camera_nodes(system, root)
    fitting = [node for node in nodes if device is None or device in node.ids]
    if not fitting:
        wanted = "no camera is plugged in" if device is None else f"no camera '{device}'"
        there = ", ".join(node.ids[0] for node in nodes) or "none"
        raise FileNotFoundError(f"{wanted}; cameras that may be opened: {there}")
    if len({node.bus for node in fitting}) > 1:
        choices = ", ".join(node.ids[0] for node in fitting)
        raise OSError(f"several cameras fit; set device to one of {choices}")
    return fitting[0]


def modes(system: KernelInterface, path: Path) -> list[str]:
    """What the camera delivers, such as ``MJPG up to 1920 x 1080``."""
    fd = system.open(str(path))
    try:
        formats = []
        form = abi.FormatDescription(type=layout_of(capabilities(system, fd)).kind)
        while supports(system, fd, abi.ENUM_FMT, form):
            name = abi.name_of(form.pixelformat)
            size = _largest(system, fd, form.pixelformat)
            formats.append(f"{name} up to {size[0]} x {size[1]}" if size else name)
            form.index += 1
        return formats
    finally:
        system.close(fd)


def _largest(system: KernelInterface, fd: int, pixelformat: int) -> tuple[int, int] | None:
    sizes = []
    size = abi.FrameSize(pixelformat=pixelformat)
    while supports(system, fd, abi.ENUM_FRAMESIZES, size):
        if size.type != abi.FRMSIZE_DISCRETE:
            # min width, max width, step, min height, max height, step
            return size.height, size.stepwise[2]
        sizes.append((int(size.width), int(size.height)))
        size.index += 1
    return max(sizes, key=lambda each: each[0] * each[1], default=None)


def _capability(system: KernelInterface, path: Path) -> abi.Capability | None:
    """The capability of a node; None if it is no camera, such as a node for metadata."""
    try:
        fd = system.open(str(path))
    except OSError:
        return None
    try:
        capability = abi.Capability()
        call(system, fd, abi.QUERYCAP, capability)
    except OSError:
        return None
    finally:
        system.close(fd)
    caps = _of_this_node(capability)
    return capability if caps & TAKES_PICTURES and caps & abi.CAP_STREAMING else None


def capabilities(system: KernelInterface, fd: int) -> int:
    """What an open node can, as V4L2_CAP_*.

    Raises:
        OSError: the device is gone, or no video device.
    """
    capability = abi.Capability()
    call(system, fd, abi.QUERYCAP, capability)
    return _of_this_node(capability)


def _of_this_node(capability: abi.Capability) -> int:
    whole = int(capability.capabilities)
    return int(capability.device_caps) if whole & abi.CAP_DEVICE_CAPS else whole


def _links(root: Path, path: Path) -> list[str]:
    """Names that udev gave it: by-id holds the maker, the model and the serial number."""
    return [
        link.name
        for folder in ("by-id", "by-path")
        for link in sorted((root / "dev/v4l" / folder).glob("*"))
        if link.resolve() == path.resolve()
    ]


def _usb_serial(root: Path, path: Path) -> list[str]:
    """The serial number, where udev does not run: two folders up from the video interface."""
    interface = (root / "sys/class/video4linux" / path.name / "device").resolve()
    try:
        serial = (interface.parent / "serial").read_text().strip()
    except OSError:
        return []
    return [serial] if serial else []


def _number(path: Path) -> int:
    digits = re.sub(r"\D", "", path.name)
    return int(digits) if digits else 0


def explain_error(error: OSError, path: Path) -> OSError:
    """The same error with a sentence that says what to do."""
    advice = {
        errno.EBUSY: "another program has it; on BlueOS, the camera manager: use its stream",
        errno.EACCES: "you may not open it; run 'sudo usermod -aG video $USER' and log in again",
        errno.ENODEV: "it was unplugged",
    }.get(error.errno or 0, error.strerror or str(error))
    return OSError(error.errno, f"{path}: {advice}")
