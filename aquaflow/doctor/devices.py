"""What can be plugged in: cameras, serial ports, CAN; and the libraries that read recordings."""

from __future__ import annotations

import os
from pathlib import Path

from aquaflow.doctor.machine import CheckResult, MachineProbes

LUXONIS_USB_VENDOR = "03e7"
"""Vendor number of Luxonis' processor (Movidius) on USB, hexadecimal."""
OTHER_OPENCVS = ("opencv-python-headless", "opencv-python", "opencv-contrib-python")
"""Packages that write into the same folder ``cv2``: whichever came last is what is imported."""
ARPHRD_CAN = "280"
"""Value of ``/sys/class/net/*/type`` for a CAN interface (linux/if_arp.h)."""


def video(machine: MachineProbes) -> CheckResult:
    """Whether OpenCV reads video files."""
    if not machine.module_present("cv2"):
        return CheckResult(
            "video files",
            "no OpenCV",
            "neither videos nor images can be read",
            "run 'pip install opencv-contrib-python-headless'",
        )
    import cv2

    backends = {cv2.videoio_registry.getBackendName(b) for b in cv2.videoio_registry.getBackends()}
    found = f"OpenCV {cv2.__version__}"
    others = [name for name in OTHER_OPENCVS if machine.version(name) is not None]
    if others:
        return CheckResult(
            "video files",
            f"{found}, and {' and '.join(others)} in the same folder",
            "pictures are read by whichever was installed last",
            f"run 'pip uninstall {' '.join(others)}', then "
            "'pip install --force-reinstall --no-deps opencv-contrib-python-headless'",
        )
    if "FFMPEG" not in backends:
        return CheckResult(
            "video files",
            f"{found} without FFmpeg",
            "folders of images are read, videos are not",
            "run 'pip install opencv-contrib-python-headless', which carries FFmpeg",
        )
    return CheckResult("video files", f"{found} with FFmpeg", "videos and images are read")


def cameras(machine: MachineProbes) -> CheckResult:
    """Cameras that Video4Linux knows."""
    # A camera has several nodes; the first (index 0) is the one that captures.
    nodes = [
        node
        for node in machine.paths("dev/video*")
        if machine.text(f"sys/class/video4linux/{node.name}/index") in {"", "0"}
    ]
    if not nodes:
        return CheckResult("USB and CSI cameras", "none", "recordings are mapped")
    names = [machine.text(f"sys/class/video4linux/{node.name}/name") for node in nodes]
    found = ", ".join(
        f"/dev/{node.name} ({name or 'no name'})" for node, name in zip(nodes, names, strict=True)
    )
    used = "read live, driver v4l2; `aquaflow doctor devices` prints its id"
    return CheckResult("USB and CSI cameras", found, used, no_access(nodes, "video"))


def oak(machine: MachineProbes) -> CheckResult:
    """Luxonis cameras on USB, and whether their library is installed."""
    products = [
        machine.text(f"sys/bus/usb/devices/{vendor.parent.name}/product") or "unnamed"
        for vendor in machine.paths("sys/bus/usb/devices/*/idVendor")
        if machine.text(str(vendor.relative_to(machine.root))) == LUXONIS_USB_VENDOR
    ]
    if not products:
        return CheckResult("OAK cameras", "none on USB", "no OAK is used")
    present = machine.module_present("depthai")
    advice = "" if present else "run `pip install 'aquaflow[oak]'` to use it (depthai, 366 MB)"
    used = "read live, driver oak" if present else "no OAK is used"
    return CheckResult("OAK cameras", ", ".join(products), used, advice)


def serial(machine: MachineProbes) -> CheckResult:
    """Serial ports, and whether this user may open them."""
    ports = machine.paths(
        "dev/serial/by-id/*", "dev/ttyUSB*", "dev/ttyACM*", "dev/ttyAMA*", "dev/ttyTHS*"
    )
    if not ports:
        return CheckResult("serial ports", "none", "no telemetry over serial")
    found = ", ".join("/" + str(port.relative_to(machine.root)) for port in ports)
    used = "can carry MAVLink, NMEA or a DVL, which give the map its scale"
    return CheckResult("serial ports", found, used, no_access(ports, "dialout"))


def no_access(nodes: list[Path], group: str) -> str:
    """What to do if a device exists but this user may not open it."""
    barred = [node for node in nodes if not os.access(node, os.R_OK | os.W_OK)]
    if not barred:
        return ""
    return (
        f"you may not open {barred[0].name}; run 'sudo usermod -aG {group} $USER' and log in again"
    )


def can(machine: MachineProbes) -> CheckResult:
    """CAN interfaces, and whether they are up."""
    found = [
        f"{kind.parent.name} ({machine.text(f'sys/class/net/{kind.parent.name}/operstate') or '?'})"
        for kind in machine.paths("sys/class/net/*/type")
        if machine.text(str(kind.relative_to(machine.root))) == ARPHRD_CAN
    ]
    if not found:
        return CheckResult("CAN", "none", "no telemetry over CAN")
    down = [name for name in found if "down" in name]
    advice = (
        f"run 'sudo ip link set {down[0].split()[0]} up type can bitrate 500000'" if down else ""
    )
    return CheckResult("CAN", ", ".join(found), "can carry vehicle telemetry", advice)
