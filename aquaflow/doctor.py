"""``aquaflow doctor``: what this machine has, what AquaFlow will use of it, and what is missing.

Devices are read from ``/dev``, ``/proc`` and ``/sys`` below a root that tests replace; nothing is
opened, so that a camera in use by another process stays undisturbed.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

ISA_LEVELS = (
    ("x86-64-v4", {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}),
    ("x86-64-v3", {"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe"}),
    ("x86-64-v2", {"cx16", "lahf_lm", "popcnt", "sse4_1", "sse4_2", "ssse3"}),
)
"""Linux flag names of the x86-64 psABI's levels, the highest first."""

COMPILERS = ("g++", "clang++", "c++")

LUXONIS_USB_VENDOR = "03e7"
ARPHRD_CAN = "280"
"""Value of ``/sys/class/net/*/type`` for a CAN interface (linux/if_arp.h)."""

LOW_MEMORY_GB = 4.0
LOW_DISK_GB = 5.0
"""An hour of 1080p recording at 10 Mbit/s takes 4.5 GB."""


@dataclass(frozen=True)
class Finding:
    """One thing looked for."""

    name: str
    found: str
    used_for: str
    """What AquaFlow will therefore do."""
    advice: str = ""
    """What to do if it is wanted; empty if nothing is missing."""

    @property
    def ok(self) -> bool:
        return not self.advice


def _torch_gpu() -> str | None:
    """Name and memory of the GPU that torch can use."""
    import torch

    if not torch.cuda.is_available():
        return None
    properties = torch.cuda.get_device_properties(0)
    return f"{properties.name}, {properties.total_memory / 1e9:.0f} GB"


def _module_present(name: str) -> bool:
    return importlib.util.find_spec(name) is not None


def _renderer_name() -> str | None:
    """What renders here without being asked for, and on which instruction set; None if nothing."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a fallback is told in the findings
        try:
            from aquaflow.render import select_renderer

            chosen = select_renderer()
            return f"{chosen.name}, {chosen.isa}"
        except ImportError:
            return None


def _native_folder() -> Path:
    return Path(__file__).parent / "render" / "native"


@dataclass(frozen=True)
class Machine:
    """The ways in which the machine is looked at; every one can be replaced by a test."""

    root: Path = Path("/")
    disk: Path = field(default_factory=Path.cwd)
    """Folder whose file system dives are written to."""
    native: Path = field(default_factory=_native_folder)
    """Folder of the compiled rasterisers."""
    which: Callable[[str], str | None] = shutil.which
    gpu: Callable[[], str | None] = _torch_gpu
    module_present: Callable[[str], bool] = _module_present
    renderer: Callable[[], str | None] = _renderer_name

    def text(self, path: str) -> str:
        """Content of a file below the root, stripped; empty if it cannot be read."""
        try:
            return (self.root / path).read_text(errors="replace").strip("\0\n ")
        except OSError:
            return ""

    def paths(self, *patterns: str) -> list[Path]:
        """Paths below the root that match, sorted within each pattern."""
        return [path for pattern in patterns for path in sorted(self.root.glob(pattern))]


def examine(machine: Machine | None = None) -> list[Finding]:
    """Look at everything AquaFlow can make use of; never raises for something absent."""
    machine = machine or Machine()
    probes = (
        *(_processor, _memory, _compiler, _renderer, _gpu, _video),
        *(_cameras, _oak, _serial, _can, _disk),
    )
    return [probe(machine) for probe in probes]


def to_json(findings: list[Finding]) -> dict[str, Any]:
    """Stable keys for ``aquaflow doctor --json``."""
    return {"findings": [{**asdict(finding), "ok": finding.ok} for finding in findings]}


def print_findings(findings: list[Finding], console: Console) -> None:
    """A table for people: what is there, what it is used for, what to do."""
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False, padding=(0, 2, 1, 0))
    table.add_column("")
    table.add_column("found", overflow="fold")
    table.add_column("what AquaFlow does", overflow="fold")
    for finding in findings:
        mark = "[green]" if finding.ok else "[yellow]"
        advice = f"\n[yellow]{escape(finding.advice)}[/]" if finding.advice else ""
        table.add_row(
            f"{mark}{escape(finding.name)}[/]",
            escape(finding.found),
            escape(finding.used_for) + advice,
        )
    console.print(table)


def isa_level(cpuinfo: str) -> str:
    """Instruction set level that ``/proc/cpuinfo`` announces."""
    for line in cpuinfo.splitlines():
        key, _, value = line.partition(":")
        if key.strip() == "flags":
            flags = set(value.split())
            return next((name for name, needs in ISA_LEVELS if needs <= flags), "x86-64")
        if key.strip() == "Features":
            return "aarch64 with NEON" if "asimd" in value.split() else "arm"
    return "unknown"


def _processor(machine: Machine) -> Finding:
    cpuinfo = machine.text("proc/cpuinfo")
    rows = [line.partition(":") for line in cpuinfo.splitlines()]
    names = [value.strip() for key, _, value in rows if key.strip() == "model name"]
    board = machine.text("proc/device-tree/model")
    cores = sum(1 for key, _, _ in rows if key.strip() == "processor")
    name = names[0] if names else board or "unknown processor"
    found = f"{name}, {cores or os.cpu_count() or 1} cores, {isa_level(cpuinfo)}"
    return Finding("processor", found, "runs tracking and mapping")


def _memory(machine: Machine) -> Finding:
    gigabytes = {
        key: float(value.split()[0]) * 1024.0 / 1e9
        for key, _, value in (line.partition(":") for line in _lines(machine, "proc/meminfo"))
        if value.split()
    }
    total, free = (gigabytes.get(key, 0.0) for key in ("MemTotal", "MemAvailable"))
    advice = (
        f"map at a smaller resolution: {total:.1f} GB is little"
        if 0 < total < LOW_MEMORY_GB
        else ""
    )
    return Finding("memory", f"{total:.1f} GB, {free:.1f} GB free", "holds the map", advice)


def _lines(machine: Machine, path: str) -> Iterator[str]:
    yield from machine.text(path).splitlines()


def _compiler(machine: Machine) -> Finding:
    for name in COMPILERS:
        if place := machine.which(name):
            return Finding("C++ compiler", place, "builds the fast rasteriser at installation")
    return Finding(
        "C++ compiler",
        "none",
        "a rasteriser that came compiled with the package is used as it is",
        "" if _variants(machine) else "install g++ and reinstall aquaflow for the fast rasteriser",
    )


def _variants(machine: Machine) -> list[str]:
    return sorted(path.name for path in machine.native.glob("*.so"))


def _renderer(machine: Machine) -> Finding:
    variants = ", ".join(_variants(machine)) or "no compiled variant"
    chosen = machine.renderer()
    if chosen is None:
        return Finding(
            "renderer",
            "none",
            "nothing can be mapped",
            "reinstall aquaflow: its renderers are missing",
        )
    return Finding("renderer", f"{chosen} (of {variants})", f"maps are rendered with: {chosen}")


def _gpu(machine: Machine) -> Finding:
    usable = machine.gpu()
    gsplat = machine.module_present("gsplat")
    if usable and gsplat:
        return Finding("GPU", f"{usable}, gsplat", "the map is optimised on the GPU")
    if usable:
        return Finding(
            "GPU",
            f"{usable}, no gsplat",
            "the GPU runs the prior; the map stays on the processor",
            "run 'pip install --no-deps gsplat' to map on the GPU",
        )
    driver = machine.which("nvidia-smi") or machine.paths("proc/driver/nvidia/version")
    if driver:
        return Finding(
            "GPU",
            "an NVIDIA driver, but torch cannot use the GPU",
            "everything runs on the processor",
            "install a CUDA build of torch that fits the driver (see pytorch.org)",
        )
    return Finding("GPU", "none", "everything runs on the processor")


def _video(machine: Machine) -> Finding:
    if not machine.module_present("cv2"):
        return Finding(
            "video files",
            "no OpenCV",
            "neither videos nor images can be read",
            "run 'pip install opencv-python-headless'",
        )
    import cv2

    backends = {cv2.videoio_registry.getBackendName(b) for b in cv2.videoio_registry.getBackends()}
    found = f"OpenCV {cv2.__version__}"
    if "FFMPEG" not in backends:
        return Finding(
            "video files",
            f"{found} without FFmpeg",
            "folders of images are read, videos are not",
            "run 'pip install opencv-python-headless', which carries FFmpeg",
        )
    return Finding("video files", f"{found} with FFmpeg", "videos and images are read")


def _cameras(machine: Machine) -> Finding:
    # A camera has several nodes; the first (index 0) is the one that captures.
    nodes = [
        node
        for node in machine.paths("dev/video*")
        if machine.text(f"sys/class/video4linux/{node.name}/index") in {"", "0"}
    ]
    if not nodes:
        return Finding("USB and CSI cameras", "none", "recordings are mapped; no live camera")
    names = [machine.text(f"sys/class/video4linux/{node.name}/name") for node in nodes]
    found = ", ".join(
        f"/dev/{node.name} ({name or 'no name'})" for node, name in zip(nodes, names, strict=True)
    )
    return Finding(
        "USB and CSI cameras", found, "'aquaflow run' can map live", _access(nodes, "video")
    )


def _oak(machine: Machine) -> Finding:
    products = [
        machine.text(f"sys/bus/usb/devices/{vendor.parent.name}/product") or "unnamed"
        for vendor in machine.paths("sys/bus/usb/devices/*/idVendor")
        if machine.text(str(vendor.relative_to(machine.root))) == LUXONIS_USB_VENDOR
    ]
    if not products:
        return Finding("OAK cameras", "none on USB", "no OAK is used")
    advice = "" if machine.module_present("depthai") else "run 'pip install depthai' to use it"
    return Finding("OAK cameras", ", ".join(products), "'aquaflow run' can map live", advice)


def _serial(machine: Machine) -> Finding:
    ports = machine.paths(
        "dev/serial/by-id/*", "dev/ttyUSB*", "dev/ttyACM*", "dev/ttyAMA*", "dev/ttyTHS*"
    )
    if not ports:
        return Finding(
            "serial ports", "none", "no telemetry over serial; MAVLink over UDP still works"
        )
    found = ", ".join("/" + str(port.relative_to(machine.root)) for port in ports)
    used = "can carry MAVLink, NMEA or a DVL, which give the map its scale"
    return Finding("serial ports", found, used, _access(ports, "dialout"))


def _access(nodes: list[Path], group: str) -> str:
    """What to do if a device exists but this user may not open it."""
    barred = [node for node in nodes if not os.access(node, os.R_OK | os.W_OK)]
    if not barred:
        return ""
    return (
        f"you may not open {barred[0].name}; run 'sudo usermod -aG {group} $USER' and log in again"
    )


def _can(machine: Machine) -> Finding:
    found = [
        f"{kind.parent.name} ({machine.text(f'sys/class/net/{kind.parent.name}/operstate') or '?'})"
        for kind in machine.paths("sys/class/net/*/type")
        if machine.text(str(kind.relative_to(machine.root))) == ARPHRD_CAN
    ]
    if not found:
        return Finding("CAN", "none", "no telemetry over CAN")
    down = [name for name in found if "down" in name]
    advice = (
        f"run 'sudo ip link set {down[0].split()[0]} up type can bitrate 500000'" if down else ""
    )
    return Finding("CAN", ", ".join(found), "can carry vehicle telemetry", advice)


def _disk(machine: Machine) -> Finding:
    free_gb = shutil.disk_usage(machine.disk).free / 1e9
    advice = "free some space or write dives elsewhere" if free_gb < LOW_DISK_GB else ""
    return Finding("disk", f"{free_gb:.0f} GB free at {machine.disk}", "holds the dives", advice)
