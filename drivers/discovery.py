"""The functions of the entry points ``aquaflow.discovery``: devices of this computer."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from aquaflow.sources.discovery import FoundDevice

LUXONIS_USB_VENDOR = "03e7"
"""USB vendor under which OAK cameras appear: Movidius, whose chip they carry."""
ARPHRD_CAN = "280"
"""Value of ``/sys/class/net/*/type`` for a CAN interface (linux/if_arp.h)."""

SERIAL_PORTS = ("ttyUSB*", "ttyACM*", "ttyAMA*", "ttyTHS*")
"""USB adapters, USB devices such as autopilots, the UARTs of a Raspberry Pi and of a Jetson."""


def v4l2_cameras(root: Path = Path("/")) -> list[FoundDevice]:
    """Cameras of the kernel, one for each piece of hardware."""
    from aquaflow.drivers.v4l2.discovery import camera_nodes, modes
    from aquaflow.drivers.v4l2.system import Kernel

    kernel = Kernel()
    found = {}
    for node in reversed(camera_nodes(kernel, root)):
        config = {"kind": "v4l2", "device": node.ids[0]}
        formats = "; ".join(modes(kernel, node.path)) or "reports no formats"
        found[node.bus] = FoundDevice("v4l2", node.ids[0], node.name, formats, config)
    return list(reversed(found.values()))


def oak_cameras(root: Path = Path("/")) -> list[FoundDevice]:
    """OAK cameras on USB and, where depthai is installed, on the network."""
    if find_spec("depthai") is None:
        count = len(_usb_devices(root, LUXONIS_USB_VENDOR))
        detail = "run `pip install 'aquaflow[oak]'` to use it"
        return [FoundDevice("oak", "?", "OAK", detail, {"kind": "oak"})] * count
    from aquaflow.drivers.oak.dai_backend import depthai

    return [
        FoundDevice(
            "oak",
            info.deviceId,
            f"OAK at {info.name}",
            info.protocol.name,
            {"kind": "oak", "device": info.deviceId},
        )
        for info in depthai().Device.getAllAvailableDevices()
    ]


def serial_ports(root: Path = Path("/")) -> list[FoundDevice]:
    """Serial ports by their persistent name; those without one by their number."""
    found = []
    named = set()
    for link in sorted((root / "dev/serial/by-id").glob("*")):
        named.add(link.resolve())
        found.append(_serial(root, link, f"now {link.resolve().name}"))
    for pattern in SERIAL_PORTS:
        for port in sorted((root / "dev").glob(pattern)):
            if port.resolve() not in named:
                found.append(_serial(root, port, "its number may change"))
    return found


def can_interfaces(root: Path = Path("/")) -> list[FoundDevice]:
    """CAN interfaces of the kernel."""
    found = []
    for kind in sorted((root / "sys/class/net").glob("*/type")):
        if _text(kind) == ARPHRD_CAN:
            name = kind.parent.name
            state = _text(kind.parent / "operstate")
            up = "down" not in state
            detail = "up" if up else f"down: sudo ip link set {name} up type can bitrate 250000"
            found.append(FoundDevice("can", name, "CAN", detail, {"kind": "can", "channel": name}))
    return found


def _serial(root: Path, port: Path, detail: str) -> FoundDevice:
    path = f"/{port.relative_to(root)}"
    return FoundDevice("serial", path, "serial port", detail, {"kind": "serial", "port": path})


def _usb_devices(root: Path, vendor: str) -> list[Path]:
    folders = sorted((root / "sys/bus/usb/devices").glob("*/idVendor"))
    return [file.parent for file in folders if _text(file) == vendor]


def _text(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""
