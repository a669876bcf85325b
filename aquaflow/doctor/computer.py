"""Processor, memory, compiler, renderer, disk, and optional packages."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from typing import NamedTuple

from aquaflow.doctor.machine import CheckResult, MachineProbes

SUPPORTED = {("x86_64", 64), ("aarch64", 64)}
"""Processors and pointer sizes that torch, onnxruntime and the compiled renderer exist for."""

ISA_LEVELS = (
    ("x86-64-v4", {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}),
    ("x86-64-v3", {"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe"}),
    ("x86-64-v2", {"cx16", "lahf_lm", "popcnt", "sse4_1", "sse4_2", "ssse3"}),
)
"""Linux flag names of the x86-64 psABI's levels, the highest first."""

COMPILERS = ("g++", "clang++", "c++")
"""Commands of C++ compilers, the one that is tried first in front."""

LOW_MEMORY_GB = 4.0
"""Below, a smaller resolution is advised; a judgement: a small dive takes 0.45 GB (benchmark), a
large one and the operating system several times that."""
LOW_DISK_GB = 5.0
"""An hour of 1080p recording at 10 Mbit/s takes 4.5 GB."""


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


def processor(machine: MachineProbes) -> CheckResult:
    """Name, cores and vector instructions of the processor."""
    cpuinfo = machine.text("proc/cpuinfo")
    rows = [line.partition(":") for line in cpuinfo.splitlines()]
    names = [value.strip() for key, _, value in rows if key.strip() == "model name"]
    board = machine.text("proc/device-tree/model")
    cores = sum(1 for key, _, _ in rows if key.strip() == "processor")
    name = names[0] if names else board or "unknown processor"
    found = f"{name}, {cores or os.cpu_count() or 1} cores, {isa_level(cpuinfo)}"
    return CheckResult("processor", found, "runs tracking and mapping")


def system(machine: MachineProbes) -> CheckResult:
    """Whether the interpreter is one of a 64-bit system."""
    architecture, bits = machine.architecture
    found = f"{architecture}, {bits}-bit"
    if machine.architecture in SUPPORTED:
        return CheckResult("system", found, "supported: AquaFlow runs on 64-bit x86_64 and aarch64")
    return CheckResult(
        "system",
        found,
        "AquaFlow cannot run here: torch and onnxruntime have no builds for it",
        "install a 64-bit system (a BlueROV2 with BlueOS's armv7 image needs a 64-bit one), or use "
        "a 64-bit computer on the vehicle's network",
    )


def memory(machine: MachineProbes) -> CheckResult:
    """Memory in all and free, GB."""
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
    return CheckResult("memory", f"{total:.1f} GB, {free:.1f} GB free", "holds the map", advice)


def _lines(machine: MachineProbes, path: str) -> Iterator[str]:
    yield from machine.text(path).splitlines()


def compiler(machine: MachineProbes) -> CheckResult:
    """The C++ compiler, if there is one."""
    for name in COMPILERS:
        if place := machine.which(name):
            return CheckResult("C++ compiler", place, "builds the fast rasteriser at installation")
    return CheckResult(
        "C++ compiler",
        "none",
        "a rasteriser that came compiled with the package is used as it is",
        "" if _variants(machine) else "install g++ and reinstall aquaflow for the fast rasteriser",
    )


def _variants(machine: MachineProbes) -> list[str]:
    return sorted(path.name for path in machine.native.glob("*.so"))


def renderer(machine: MachineProbes) -> CheckResult:
    """The renderer that maps are drawn with."""
    variants = ", ".join(_variants(machine)) or "no compiled variant"
    chosen = machine.renderer()
    if chosen is None:
        return CheckResult(
            "renderer",
            "none",
            "nothing can be mapped",
            "reinstall aquaflow: its renderers are missing",
        )
    return CheckResult("renderer", f"{chosen} (of {variants})", f"maps are rendered with: {chosen}")


def disk(machine: MachineProbes) -> CheckResult:
    """Room where dives are written, GB."""
    free_gb = shutil.disk_usage(machine.disk).free / 1e9
    advice = "free some space or write dives elsewhere" if free_gb < LOW_DISK_GB else ""
    return CheckResult(
        "disk", f"{free_gb:.0f} GB free at {machine.disk}", "holds the dives", advice
    )


# --------------------------------------------------------------------------------------------------
# Optional packages: which version is installed, what it is for, and what installs it.
#
# Nothing is imported: some of them take seconds, and one prints.


class Package(NamedTuple):
    """One line of an extra in pyproject.toml."""

    distribution: str
    module: str
    extra: str
    purpose: str


PACKAGES = (
    Package("pymavlink", "pymavlink", "telemetry", "MAVLink: autopilots, tlog and dataflash logs"),
    Package("websockets", "websockets", "telemetry", "MAVLink by BlueOS's mavlink2rest"),
    Package("pyserial", "serial", "telemetry", "devices on serial ports"),
    Package("python-can", "can", "telemetry", "devices on CAN buses, candump logs"),
    Package("cantools", "cantools", "telemetry", "CAN buses that a DBC file describes"),
    Package("msgpack", "msgpack", "telemetry", "CAN over UDP multicast"),
    Package("mcap", "mcap", "recording", "recordings: written and mapped"),
    Package("mcap-protobuf-support", "mcap_protobuf", "recording", "MCAP files of others"),
    Package(
        "foxglove-schemas-protobuf", "foxglove_schemas_protobuf", "recording",
        "pictures in recordings, for Foxglove and Lichtblick",
    ),
    Package("rosbags", "rosbags", "recording", "ROS 1 and 2 bags; a dive as ROS 2 messages"),
    Package("zstandard", "zstandard", "recording", "compressed ROS 2 bags"),
    Package("websockets", "websockets", "foxglove", "a running dive in Foxglove"),
    Package("ray", "ray", "cluster", "batches of dives on several machines"),
    Package("s3fs", "s3fs", "s3", "batches of dives from and to S3"),
    Package("laspy", "laspy", "survey", "points of a dive as LAZ"),
    Package("lazrs", "lazrs", "survey", "points of a dive as LAZ"),
    Package("pye57", "pye57", "survey", "points of a dive as E57"),
    Package("rasterio", "rasterio", "survey", "orthos and heights as GeoTIFF"),
    Package("contourpy", "contourpy", "survey", "contours of heights"),
    Package("scikit-image", "skimage", "survey", "the surface of a dive as triangles"),
    Package("xatlas", "xatlas", "survey", "textured meshes: OBJ and GLB"),
    Package("depthai", "depthai", "oak", "Luxonis OAK cameras"),
    Package("onnxruntime", "onnxruntime", "prior", "learned priors"),
    Package("kornia", "kornia", "prior-peers", "the priors xfeat and aliked"),
    Package("gsplat", "gsplat", "gpu", "maps on a GPU with CUDA"),
    Package("wgpu", "wgpu", "gpu-any", "maps on a GPU of any maker"),
    Package("lpips", "lpips", "lpips", "LPIPS of the held-out views"),
    Package("onnx", "onnx", "export", "exporting a trained prior"),
    Package("onnxscript", "onnxscript", "export", "exporting a trained prior"),
    Package("pycolmap", "pycolmap", "peers", "COLMAP beside AquaFlow in `aquaflow lab bench`"),
)  # fmt: skip
OTHER_BUILDS = {"onnxruntime": ("onnxruntime-gpu",)}
"""Distributions that hold the same module."""
INSTALLED_OTHERWISE = {
    # What it asks for would replace the build of torch that is installed.
    "gsplat": "pip install --no-deps gsplat",
    # Its code is not run, so what that asks for is not needed: torchvision, of torch's own build.
    "lpips": "pip install --no-deps lpips",
}
"""Commands for packages that an extra does not install well."""


def findings(machine: MachineProbes) -> list[CheckResult]:
    """A finding for each optional package."""
    return [_finding(package, machine) for package in PACKAGES]


def _finding(package: Package, machine: MachineProbes) -> CheckResult:
    name, extra = package.distribution, package.extra
    row = f"package {name}"  # what a GPU does with gsplat is another finding
    if machine.module_present(package.module):
        names = (name, *OTHER_BUILDS.get(name, ()))
        version = next(filter(None, map(machine.version, names)), "of unknown version")
        return CheckResult(row, version, package.purpose)
    command = INSTALLED_OTHERWISE.get(name, f"pip install 'aquaflow[{extra}]'")
    return CheckResult(row, "not installed", f"{package.purpose}: not here", f"run `{command}`")
