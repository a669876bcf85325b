"""What a run with a config would open, and whether that is there now; nothing is opened but files.

Devices are looked for in /dev and /sys, and a port that AquaFlow would listen on is bound for a
moment; another computer is not asked.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

from aquaflow.base.errors import AquaFlowError, reason_of
from aquaflow.config import Config
from aquaflow.config.cameras import CameraConfig, OakConfig, V4l2Config
from aquaflow.config.link import CanConfig, Mavlink2restConfig, SerialConfig, TcpConfig, UdpConfig
from aquaflow.config.service import FoxgloveConfig, ListenConfig
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.doctor import devices
from aquaflow.doctor.machine import CheckResult, MachineProbes
from aquaflow.geometry.camera import load_camera
from aquaflow.web.access import read_token

Link = SerialConfig | UdpConfig | TcpConfig | CanConfig | Mavlink2restConfig

NOT_ASKED = "another computer, which was not asked"


def check_opened(config: Config, machine: MachineProbes | None = None) -> list[CheckResult]:
    """Each thing under the path of its key; ``ok`` where it can be used now."""
    machine = machine or MachineProbes()
    found = [*_of_any(config)]
    if isinstance(config, VehicleConfig):
        found += _of_vehicle(config, machine)
    return found


def _of_any(config: Config) -> Iterator[CheckResult]:
    if config.source.mask is not None:
        yield _file("source.mask", config.source.mask)
    if config.prior.folder is not None:
        yield _folder("prior.folder", config.prior.folder)
    if config.prior.engine_cache is not None:
        yield _check_writable("prior.engine_cache", config.prior.engine_cache)


def _of_vehicle(config: VehicleConfig, machine: MachineProbes) -> Iterator[CheckResult]:
    for name, camera in config.cameras.items():
        yield _camera(f"cameras.{name}", camera, machine)
        if camera.calibration is not None:
            yield _calibration(f"cameras.{name}.calibration", camera.calibration)
    for name, device in config.telemetry.devices.items():
        key = f"telemetry.devices.{name}"
        yield _link(f"{key}.link", device.link, machine)
        if device.kind == "dbc":
            yield _file(f"{key}.database", Path(device.database))
    service = config.service
    if service.camera is not None and service.camera not in config.cameras:
        known = ", ".join(config.cameras) or "none"
        advice = f"name one of the cameras: {known}"
        yield CheckResult("service.camera", "no such camera", service.camera, advice)
    yield _check_writable("service.dives", service.dives)
    if service.dive.site is not None:
        yield _folder("service.dive.site", service.dive.site)
    for key, listen in (
        ("service.health", service.health),
        ("service.foxglove", service.foxglove),
        ("viewer", config.viewer),
    ):
        if listen.enabled:
            yield from _listening(key, listen)


def _camera(key: str, camera: CameraConfig, machine: MachineProbes) -> CheckResult:
    if isinstance(camera, V4l2Config):
        return _v4l2(key, camera.device, machine)
    if isinstance(camera, OakConfig):
        found = devices.oak(machine)
        used = f"OAK camera {camera.device or '(the first found)'}"
        there = found.found != "none on USB"
        advice = found.advice if there else "plug it in; one on the network was not asked"
        return CheckResult(key, found.found, used, advice)
    if "://" not in camera.url:
        if camera.url.startswith("v=0"):
            return CheckResult(key, "in the config", "session description")
        return _file(f"{key}.url", Path(camera.url))
    parts = urlsplit(camera.url)
    address = f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"
    if parts.scheme in ("udp", "rtp"):
        return _port(key, socket.SOCK_DGRAM, parts.hostname or "", parts.port or 0, address)
    return CheckResult(key, NOT_ASKED, f"stream {address}")


def _v4l2(key: str, device: str | None, machine: MachineProbes) -> CheckResult:
    """By the names that udev gave; a serial number or bus is known to the camera alone."""
    links = machine.paths("dev/v4l/by-id/*", "dev/v4l/by-path/*")
    nodes = machine.paths("dev/video*")
    if device is None:
        used, fitting = "the only camera", nodes
    else:
        used, fitting = f"camera {device}", [each for each in links if each.name == device]
    if fitting:
        barred = devices.no_access(fitting[:1], "video")
        return CheckResult(key, "/" + str(fitting[0].relative_to(machine.root)), used, barred)
    there = ", ".join(each.name for each in links) or ", ".join(each.name for each in nodes)
    advice = "plug it in, or give an id as `aquaflow doctor devices` prints it"
    return CheckResult(key, f"not found; there: {there or 'no camera'}", used, advice)


def _link(key: str, link: Link, machine: MachineProbes) -> CheckResult:
    if isinstance(link, SerialConfig):
        path, used = machine.root / link.port.lstrip("/"), f"serial port {link.port}"
        if not path.exists():
            return CheckResult(key, "not there", used, "plug it in, or name one that is there")
        return CheckResult(key, "there", used, devices.no_access([path], "dialout"))
    if isinstance(link, CanConfig):
        used = f"CAN {link.channel} by {link.interface}"
        if link.interface != "socketcan":
            return CheckResult(key, "not looked for", used)
        state = machine.text(f"sys/class/net/{link.channel}/operstate")
        command = f"run 'sudo ip link set {link.channel} up type can bitrate 250000'"
        return CheckResult(
            key, state or "not there", used, command if state in ("", "down") else ""
        )
    return _address(key, link)


def _address(key: str, link: UdpConfig | TcpConfig | Mavlink2restConfig) -> CheckResult:
    if isinstance(link, Mavlink2restConfig):
        return CheckResult(key, NOT_ASKED, f"mavlink2rest {link.url}")
    if isinstance(link, UdpConfig) and link.mode == "listen":
        used = f"UDP {link.host}:{link.port}"
        return _port(key, socket.SOCK_DGRAM, link.host, link.port, used)
    return CheckResult(key, NOT_ASKED, f"{link.kind.upper()} {link.host}:{link.port}")


def _listening(key: str, listen: ListenConfig | FoxgloveConfig) -> Iterator[CheckResult]:
    used = f"TCP {listen.host}:{listen.port}"
    yield _port(key, socket.SOCK_STREAM, listen.host, listen.port, used)
    token = getattr(listen, "token_file", None)
    if token is None:
        return
    try:
        read_token(token)
    except AquaFlowError as error:
        yield CheckResult(f"{key}.token_file", "cannot be used", f"file {token}", str(error))
    else:
        yield CheckResult(f"{key}.token_file", "there", f"file {token}")


def _port(key: str, kind: socket.SocketKind, host: str, port: int, used: str) -> CheckResult:
    """Whether a port of this computer is free; a multicast group's is for everybody."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family, kind) as trial:
            if kind == socket.SOCK_STREAM:  # as servers do: a port in TIME_WAIT is free
                trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind((host, port))
    except (OSError, OverflowError) as error:
        advice = "end the program that has it (a running service has its own), or name another"
        return CheckResult(key, f"cannot listen: {reason_of(error)}", used, advice)
    return CheckResult(key, "free", used)


def _calibration(key: str, path: Path) -> CheckResult:
    try:
        load_camera(path)
    except AquaFlowError as error:
        return CheckResult(key, "cannot be used", f"file {path}", str(error))
    return CheckResult(key, "there", f"file {path}")


def _file(key: str, path: Path) -> CheckResult:
    if not path.is_file():
        return CheckResult(key, "not there", f"file {path}", "put it there, or name another")
    readable = os.access(path, os.R_OK)
    return CheckResult(key, "there", f"file {path}", "" if readable else "let this user read it")


def _folder(key: str, path: Path) -> CheckResult:
    there = path.is_dir()
    advice = "" if there else "put it there, or name another"
    return CheckResult(key, "there" if there else "not there", f"folder {path}", advice)


def _check_writable(key: str, path: Path) -> CheckResult:
    """A folder that is made where it is not there yet."""
    last = next(each for each in (path.absolute(), *path.absolute().parents) if each.exists())
    found = "there" if last == path.absolute() else "will be made"
    may = last.is_dir() and os.access(last, os.W_OK | os.X_OK)
    advice = "" if may else f"this user may not write to {last}; change that, or name another"
    return CheckResult(key, found, f"folder {path}", advice)
