"""A BlueROV2 without its thrusters: what AquaFlow meets on one, over real sockets.

An ArduSub behind a TCP endpoint of BlueOS, a Ping1D as component 194 on the same link, a Water
Linked DVL on the tether's network, and the pilot's camera as BlueOS sends it: H.264 in RTP to a UDP
port. ``aquaflow run`` is the installed program, in a process of its own.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from aquaflow.sim_drivers.camera_feed import CameraFeed
from aquaflow.sim_drivers.devices.ardusub import ArduSub
from aquaflow.sim_drivers.devices.device import SimulatedDevice
from aquaflow.sim_drivers.devices.waterlinked import WaterLinkedJson
from aquaflow.sim_drivers.devices.wires import TcpWire
from aquaflow.sim_drivers.rtp_camera import RtpCamera
from tests.drivers.camera_scenes import free_port
from tests.drivers.simulated_links import endless, motion
from tests.live.there_and_back import ThereAndBack
from tests.small_recording import FRAMES, HEIGHT

GIVE_UP_S = 120.0
"""Longest wait; a test that fails waits for it alone."""

PING = 194
"""Component of BlueOS's Ping service."""
TOKEN = "correct-horse-battery"
FPS = 5.0
"""A machine that is slow takes most pictures all the same."""
STALL_S = 4.0

CONFIG = """
# The pilot swims to and fro over 24 pictures: wherever a dive begins, it starts within 11 of them.
lab: true
threads: 1
cameras:
  pilot: {{kind: stream, url: "udp://0.0.0.0:{camera}", stall_s: {stall_s}}}
telemetry:
  devices:
    autopilot:
      kind: mavlink
      link: {{kind: tcp, host: 127.0.0.1, port: {autopilot}}}
      also: [{{component_id: {ping}, messages: [DISTANCE_SENSOR]}}]
    dvl: {{kind: waterlinked_json, link: {{kind: tcp, host: 127.0.0.1, port: {dvl}}}}}
tracking:
  initialisation: {{parallax_widths: 0.025}}
mapping:
  medium: {{enabled: false}}
  optimiser: {{steps_keyframe: 2, steps_mapping: 2, steps_common: 1, refine_steps: 10}}
service:
  dives: {root}/dives
  dive: {{begin: {begin}, finish: {finish}, disarmed_s: 1.0, commands: true}}
  checkpoint: {{every_s: 0.5}}
  hang_s: 600.0
  mapping: {{steps_per_view: 2}}
  health: {{port: {page}, token_file: {root}/token}}
"""


class InMacroblocks(ThereAndBack):
    """Pictures of as many rows as the simulated encoder takes: a multiple of 16."""

    def __init__(self, recording: Path) -> None:
        super().__init__(recording, FRAMES)
        rows = HEIGHT - HEIGHT % 16
        self._seen = [replace(frame, image=frame.image[:rows]) for frame in self._seen]


class BlueRov2:
    """The vehicle, and AquaFlow on it while it runs."""

    def __init__(self, recording: Path, root: Path, begin: str, finish: str) -> None:
        """``begin`` and ``finish``: as in ``service.dive``."""
        self.root = root
        self.autopilot = ArduSub(sonar_component=PING)
        camera = free_port()
        self.camera = RtpCamera(camera, CameraFeed(InMacroblocks(recording), FPS))
        self.port = free_tcp_port()
        self._wires = TcpWire(), TcpWire()
        token = root / "token"
        token.write_text(TOKEN)
        token.chmod(0o600)
        ports = {"autopilot": self._wires[0].port, "dvl": self._wires[1].port}
        ports |= {"camera": camera, "page": self.port, "ping": PING}
        config = CONFIG.format(**ports, root=root, stall_s=STALL_S, begin=begin, finish=finish)
        (root / "vehicle.yaml").write_text(config)
        self._process: subprocess.Popen[str] | None = None

    @contextmanager
    def switched_on(self) -> Iterator[BlueRov2]:
        """Devices that work; at the end AquaFlow is not left behind either."""
        enough = threading.Event()
        with ExitStack() as stack:
            for protocol, wire in zip(
                (self.autopilot, WaterLinkedJson()), self._wires, strict=True
            ):
                device = SimulatedDevice(protocol, wire, endless(motion(), enough)).start()
                stack.callback(device.close)
            stack.callback(enough.set)
            stack.enter_context(self.camera)
            stack.callback(self.kill)
            yield self

    # --- AquaFlow's process ---------------------------------------------------------------------

    def start(self) -> None:
        """``aquaflow run``, until its page answers."""
        command = [program(), "run", "--config", str(self.root / "vehicle.yaml")]
        with (self.root / "stderr.txt").open("a") as errors:
            self._process = subprocess.Popen(
                command, stdout=subprocess.DEVNULL, stderr=errors, text=True
            )
        self.until(lambda said: True, "page")

    def kill(self) -> None:
        """As a power cut does."""
        self._ended(signal.SIGKILL)

    def stop(self) -> int:
        """As systemd does: the exit status."""
        return self._ended(signal.SIGTERM)

    def _ended(self, by: signal.Signals) -> int:
        if self._process is None:
            return 0
        self._process.send_signal(by)
        status = self._process.wait(GIVE_UP_S)
        self._process = None
        return status

    # --- the pilot ------------------------------------------------------------------------------

    def health(self) -> dict[str, Any]:
        said: dict[str, Any] = self._asked("GET", "/health")[1]
        return said

    def ask(self, what: str) -> int:
        """A button: the HTTP status of the answer."""
        return self._asked("POST", f"/dive/{what}")[0]

    def until(self, true: Callable[[dict[str, Any]], bool], what: str) -> dict[str, Any]:
        """Wait for what /health says."""
        deadline, said = time.monotonic() + GIVE_UP_S, {"state": "silent", "reason": ""}
        while time.monotonic() < deadline:
            with contextlib.suppress(ConnectionError):
                said = self.health()
                if true(said):
                    return said
            assert self._process is None or self._process.poll() is None, self.errors()
            time.sleep(0.05)
        raise AssertionError(f"no {what} but {json.dumps(said)}\n{self.errors()}")

    def until_state(self, state: str) -> dict[str, Any]:
        return self.until(lambda said: said["state"] == state, state)

    def errors(self) -> str:
        """What AquaFlow printed."""
        return (self.root / "stderr.txt").read_text()[-3000:]

    def _asked(self, method: str, target: str) -> tuple[int, dict[str, Any]]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=GIVE_UP_S)
        connection.request(method, target, headers={"Authorization": f"Bearer {TOKEN}"})
        answer = connection.getresponse()
        body: dict[str, Any] = json.loads(answer.read())
        connection.close()
        return answer.status, body


def free_tcp_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def program() -> str:
    """The installed ``aquaflow``."""
    return str(Path(sys.executable).with_name("aquaflow"))
