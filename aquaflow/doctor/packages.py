"""Optional packages: which version is installed, what it is for, and what installs it.

Nothing is imported: some of them take seconds, and one prints.
"""

from __future__ import annotations

from typing import NamedTuple

from aquaflow.doctor.machine import CheckResult, MachineProbes


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
    Package("scikit-image", "skimage", "survey", "the surface of a dive as triangles"),
    Package("xatlas", "xatlas", "survey", "textured meshes: OBJ and GLB"),
    Package("depthai", "depthai", "oak", "Luxonis OAK cameras"),
    Package("onnxruntime", "onnxruntime", "prior", "learned priors"),
    Package("kornia", "kornia", "prior-peers", "the priors xfeat and aliked"),
    Package("gsplat", "gsplat", "gpu", "maps on a GPU with CUDA"),
    Package("onnx", "onnx", "export", "exporting a trained prior"),
    Package("onnxscript", "onnxscript", "export", "exporting a trained prior"),
    Package("pycolmap", "pycolmap", "peers", "COLMAP beside AquaFlow in `aquaflow lab bench`"),
)  # fmt: skip
OTHER_BUILDS = {"onnxruntime": ("onnxruntime-gpu",)}
"""Distributions that hold the same module."""
INSTALLED_OTHERWISE = {
    # What it asks for would replace the build of torch that is installed.
    "gsplat": "pip install --no-deps gsplat",
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
