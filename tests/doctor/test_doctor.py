"""The doctor on machines made of files: what is there, what is used, what is missing."""

from __future__ import annotations

import io
import json
import os
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from rich.console import Console

from aquaflow.doctor import CheckResult, MachineProbes, examine, print_findings, to_json
from aquaflow.doctor.attempts import Attempt
from aquaflow.doctor.computer import PACKAGES, isa_level
from aquaflow.doctor.machine import renderer_name

V4 = "avx512f avx512bw avx512cd avx512dq avx512vl"
CPUINFO = f"processor\t: 0\nmodel name\t: Test CPU\nflags\t\t: fpu {V4}\nprocessor\t: 1\n"
PI = "processor\t: 0\nFeatures\t: fp asimd crc32\n"


@pytest.fixture
def machine(tmp_path):
    """A machine with nothing but a processor; tests add what they need."""
    put(tmp_path, "proc/cpuinfo", CPUINFO)
    put(tmp_path, "proc/meminfo", "MemTotal: 16000000 kB\nMemAvailable: 8000000 kB\n")
    (tmp_path / "native").mkdir()
    return bare(tmp_path)


def put(root: Path, path: str, content: str = "") -> None:
    (root / path).parent.mkdir(parents=True, exist_ok=True)
    (root / path).write_text(content)


def bare(root: Path, **changes: object) -> MachineProbes:
    parts = {
        "root": root,
        "disk": root,
        "native": root / "native",
        "which": lambda name: None,
        "gpu": lambda: "torch is a build for the processor",
        "onnx_providers": lambda: ["CPUExecutionProvider"],
        "attempt": lambda name: Attempt(failed=f"{name} is not to be tried"),
        "module_present": lambda name: False,
        "version": lambda name: None,
        "renderer": lambda: "tiles, torch",
        "architecture": ("x86_64", 64),
    }
    return MachineProbes(**{**parts, **changes})  # type: ignore[arg-type]


def named(machine: MachineProbes, name: str) -> CheckResult:
    return next(finding for finding in examine(machine) if finding.name == name)


def test_processor_is_described_from_cpuinfo(machine):
    assert named(machine, "processor").found == "Test CPU, 2 cores, x86-64-v4"


def test_board_name_stands_in_for_a_processor_without_one(machine):
    put(machine.root, "proc/cpuinfo", PI)
    put(machine.root, "proc/device-tree/model", "Raspberry Pi 5\0")

    assert named(machine, "processor").found == "Raspberry Pi 5, 1 cores, aarch64 with NEON"


@pytest.mark.parametrize("architecture", [("x86_64", 64), ("aarch64", 64)])
def test_64_bit_systems_are_supported(machine, architecture):
    assert named(bare(machine.root, architecture=architecture), "system").ok


@pytest.mark.parametrize("architecture", [("armv7l", 32), ("aarch64", 32), ("riscv64", 64)])
def test_other_systems_are_said_not_to_be(machine, architecture):
    finding = named(bare(machine.root, architecture=architecture), "system")

    assert finding.found == f"{architecture[0]}, {architecture[1]}-bit"
    assert "cannot run here" in finding.used_for
    assert "BlueOS's armv7 image" in finding.advice


def test_the_gpu_probe_needs_no_torch(monkeypatch):
    monkeypatch.setitem(sys.modules, "aquaflow.render.gsplat", None)

    assert MachineProbes().gpu() == "torch is not installed"


def test_the_network_probe_needs_no_onnxruntime(monkeypatch):
    assert "CPUExecutionProvider" in MachineProbes().onnx_providers()
    monkeypatch.setitem(sys.modules, "onnxruntime", None)

    assert MachineProbes().onnx_providers() == []


@pytest.mark.parametrize(
    ("flags", "level"),
    [
        (V4, "x86-64-v4"),
        ("avx avx2 bmi1 bmi2 f16c fma abm movbe", "x86-64-v3"),
        ("cx16 lahf_lm popcnt sse4_1 sse4_2 ssse3", "x86-64-v2"),
        ("sse2", "x86-64"),
    ],
)
def test_isa_level_is_the_highest_whose_flags_are_all_there(flags, level):
    assert isa_level(f"flags : {flags}") == level


def test_isa_level_of_other_machines():
    assert isa_level("Features : half thumb") == "arm"
    assert isa_level("") == "unknown"


def test_little_memory_is_advised_on(machine):
    assert named(machine, "memory").found == "16.4 GB, 8.2 GB free"
    assert named(machine, "memory").ok
    put(machine.root, "proc/meminfo", "MemTotal: 2000000 kB\n")
    assert "smaller resolution" in named(machine, "memory").advice


def test_missing_compiler_matters_only_without_a_compiled_variant(machine):
    assert "install g++" in named(machine, "C++ compiler").advice
    put(machine.root, "native/libaquaflow_avx2.so")
    assert named(machine, "C++ compiler").ok
    found = bare(machine.root, which=lambda name: f"/usr/bin/{name}")
    assert named(found, "C++ compiler").found == "/usr/bin/g++"


def test_renderer_in_use_and_its_variants_are_named(machine):
    put(machine.root, "native/libaquaflow_avx2.so")
    assert named(machine, "renderer").found == "tiles, torch (of libaquaflow_avx2.so)"
    absent = bare(machine.root, renderer=lambda: None)
    assert "reinstall" in named(absent, "renderer").advice


def test_absent_render_package_is_no_error(monkeypatch):
    monkeypatch.setitem(sys.modules, "aquaflow.render", None)

    assert renderer_name() is None


def test_video_support_is_that_of_the_installed_opencv(machine):
    assert "opencv" in named(machine, "video files").advice
    real = bare(machine.root, module_present=lambda name: name == "cv2")
    assert "with FFmpeg" in named(real, "video files").found


def test_a_second_opencv_in_the_same_folder_is_named_with_what_removes_it(machine):
    both = bare(
        machine.root,
        module_present=lambda name: name == "cv2",
        version=lambda name: "5.0" if name == "opencv-python" else None,
    )
    assert "opencv-python in the same folder" in named(both, "video files").found
    assert "'pip uninstall opencv-python'" in named(both, "video files").advice


def test_cameras_are_named_once_whatever_their_number_of_nodes(machine):
    for number, index in ((0, 0), (1, 1)):
        put(machine.root, f"dev/video{number}")
        put(machine.root, f"sys/class/video4linux/video{number}/name", "exploreHD\n")
        put(machine.root, f"sys/class/video4linux/video{number}/index", f"{index}\n")

    assert named(machine, "USB and CSI cameras").found == "/dev/video0 (exploreHD)"


def test_device_without_permission_is_advised_on(machine, monkeypatch):
    put(machine.root, "dev/video0")
    put(machine.root, "dev/ttyACM0")
    monkeypatch.setattr(os, "access", lambda path, mode: False)

    assert "-aG video" in named(machine, "USB and CSI cameras").advice
    assert "-aG dialout" in named(machine, "serial ports").advice


def test_oak_is_found_by_its_usb_vendor(machine):
    put(machine.root, "sys/bus/usb/devices/1-2/idVendor", "03e7\n")
    put(machine.root, "sys/bus/usb/devices/1-2/product", "Movidius MyriadX\n")
    put(machine.root, "sys/bus/usb/devices/1-3/idVendor", "046d\n")

    finding = named(machine, "OAK cameras")

    assert finding.found == "Movidius MyriadX"
    assert "depthai" in finding.advice


def test_serial_ports_are_listed_by_their_stable_names_first(machine):
    put(machine.root, "dev/ttyUSB0")
    put(machine.root, "dev/serial/by-id/usb-Pixhawk")

    assert named(machine, "serial ports").found == "/dev/serial/by-id/usb-Pixhawk, /dev/ttyUSB0"


def test_can_is_told_from_ethernet_and_brought_up(machine):
    put(machine.root, "sys/class/net/eth0/type", "1\n")
    put(machine.root, "sys/class/net/can0/type", "280\n")
    put(machine.root, "sys/class/net/can0/operstate", "down\n")

    finding = named(machine, "CAN")

    assert finding.found == "can0 (down)"
    assert "ip link set can0 up" in finding.advice


def test_full_disk_is_advised_on(machine, monkeypatch):
    usage = type("Usage", (), {"free": 1e9})
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)

    assert "free some space" in named(machine, "disk").advice


def test_findings_as_json_have_stable_keys(machine):
    rows = to_json(examine(machine))["findings"]

    assert all(set(row) == {"name", "found", "used_for", "advice", "figures", "ok"} for row in rows)
    json.dumps(rows)


def test_table_shows_every_finding_and_its_advice(machine):
    text = io.StringIO()
    print_findings(examine(machine), Console(file=text, width=200))

    for finding in examine(machine):
        assert finding.name in text.getvalue()
        assert finding.advice in text.getvalue()


def test_this_machine_is_examined_without_an_error():
    adapters = find_spec("wgpu") is not None  # then they are tried
    assert len(examine()) == 12 + adapters + len(PACKAGES)
