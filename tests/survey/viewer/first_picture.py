"""How long a real browser waits for a dive behind a slow link, and what is sent until then:

    python -m tests.survey.viewer.first_picture DIVE [--gaussians 500000] [--mbit 10]

DIVE is any finished dive, which is shown by ``aquaflow view`` in a process of its own, at first
without a packed map (view.zip is removed), then with it. With ``--gaussians`` its map is replaced,
in a copy, by a textured relief of 20 x 20 m. The browser is a headless Chromium with an empty cache
that draws on the processor.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from aquaflow.dive.ply import PlyGaussians, write_ply
from aquaflow.survey.viewer.packing import NAME
from tests.browser import Browser

ROUND_TRIP_S = 0.02
PIECE = 8192
"""Bytes that are let through at a time."""


class SlowLink:
    """A relay at ``port`` to a server on this machine; answers pass at ``rate``, bytes/s, all
    connections together."""

    def __init__(self, inside: int, rate: float) -> None:
        self._inside, self._rate, self._free_s = inside, rate, 0.0
        self._lock = threading.Lock()
        self.sent: list[tuple[float, int]] = []
        """When, and how many bytes."""
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listening.getsockname()[1])
        threading.Thread(target=self._run, daemon=True).start()

    def until(self, t_s: float) -> int:
        """Bytes that had been sent at a time of the monotonic clock."""
        return sum(count for at, count in self.sent if at <= t_s)

    def _run(self) -> None:
        while True:
            client, _ = self._listening.accept()
            server = socket.create_connection(("127.0.0.1", self._inside))
            for pair in ((client, server, False), (server, client, True)):
                threading.Thread(target=self._copy, args=pair, daemon=True).start()

    def _copy(self, source: socket.socket, sink: socket.socket, slow: bool) -> None:
        try:
            while data := source.recv(PIECE):
                if slow:
                    self._wait_for(len(data))
                else:
                    time.sleep(ROUND_TRIP_S)
                sink.sendall(data)
            sink.shutdown(socket.SHUT_WR)
        except OSError:
            pass

    def _wait_for(self, count: int) -> None:
        with self._lock:
            now = time.monotonic()
            self._free_s = max(self._free_s, now) + count / self._rate
            self.sent.append((self._free_s, count))
            wait = self._free_s - now
        time.sleep(wait)


def relief(count: int) -> tuple[PlyGaussians, PlyGaussians]:
    """A textured sea floor through water, and without it."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-10.0, 10.0, (2, count))
    z = 5.0 + 0.6 * np.sin(0.7 * x) * np.cos(0.5 * y) + 0.25 * np.sin(2.1 * x + 1) * np.sin(1.7 * y)
    scales = np.exp(rng.normal(np.log(0.02), 0.5, (count, 1))) * np.array([1.0, 1.0, 0.3])
    turn = rng.normal(scale=(0.2, 0.2, 0.2), size=(count, 3))
    texture = 0.5 + 0.5 * np.sin(3 * x + 2 * np.sin(1.3 * y)) * np.cos(2.3 * y)
    check = (np.floor(x) + np.floor(y)) % 2
    clear = np.stack([0.7 * texture + 0.2 * check, 0.55 * texture + 0.1, 0.65 - 0.3 * texture], 1)
    clear = np.clip(clear + rng.normal(scale=0.05, size=clear.shape), 0.0, 1.0)
    T = np.exp(-5.0 * np.array([0.35, 0.08, 0.06]))
    water = clear * T + np.array([0.02, 0.2, 0.28]) * (1.0 - T)
    plain = {
        "means": np.stack([x, y, z], 1), "wxyz": np.column_stack([np.ones(count), turn]),
        "scales": scales, "opacities": rng.uniform(0.4, 0.99, count),
    }  # fmt: skip
    return PlyGaussians(colours=water, **plain), PlyGaussians(colours=clear, **plain)


class Server:
    """``aquaflow view`` of a dive."""

    def __init__(self, dive: Path) -> None:
        """Wait until it listens."""
        began = time.monotonic()
        command = [sys.executable, "-m", "aquaflow", "view", str(dive), "--port", "0"]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        said = re.search(r"http://[^/]+:(\d+)/", self._process.stdout.readline())
        assert said is not None, "the viewer did not start"
        self.port, self.ready_s = int(said[1]), time.monotonic() - began

    @property
    def cpu_s(self) -> float:
        """That it used so far."""
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    @property
    def peak_mb(self) -> float:
        """Most that was resident, pages of mapped files included."""
        said = Path(f"/proc/{self._process.pid}/status").read_text()
        return int(said.partition("VmHWM:")[2].split()[0]) / 1024.0

    def close(self) -> None:
        """End it as Ctrl-C does."""
        self._process.send_signal(signal.SIGINT)
        self._process.wait(60.0)


SETTLE_S = 3.0
"""Until tiles near the eye came, for a picture of the whole."""
ARRIVED = """return performance.getEntriesByType("resource")
    .find(each => /map\\/.*\\/0$/.test(each.name)).responseEnd"""
"""When the first chunk was there, packed, ms."""


def measure(dive: Path, mbit: float, picture: Path | None) -> dict[str, float]:
    """Seconds since the address was opened, megabytes sent by then, and what the server took."""
    server = Server(dive)
    found = {"server_ready_s": server.ready_s, "server_ready_cpu_s": server.cpu_s}
    link = SlowLink(server.port, mbit * 1e6 / 8)
    with tempfile.TemporaryDirectory() as profile:
        browser = Browser(Path(profile) / "profile", webgl=True)
        try:
            browser.emulate(1280, 800)
            opened = time.monotonic()
            browser.open(f"http://127.0.0.1:{link.port}/")
            browser.wait("window.aquaflowTimes?.first")
            found |= {"server_first_cpu_s": server.cpu_s, "server_first_mb": server.peak_mb}
            arrived_s = browser.run(ARRIVED) / 1000.0
            if picture is not None:
                browser.screenshot(picture)
            browser.wait("window.aquaflowTimes.whole")
            times = browser.run("return window.aquaflowTimes")
            if picture is not None:
                time.sleep(SETTLE_S)
                browser.screenshot(picture.with_stem(f"{picture.stem}_whole"))
            found |= {"server_whole_cpu_s": server.cpu_s, "server_whole_mb": server.peak_mb}
        finally:
            browser.close()
            server.close()
    seconds = {name: times[name] / 1000.0 for name in ("script", "data", "first", "whole")}
    seconds["arrived"] = arrived_s
    sent = {f"{name}_mb": link.until(opened + t_s) / 1e6 for name, t_s in seconds.items()}
    return {**found, **seconds, **sent, "gaussian_us": times["cost_us"]}


def looks(dive: Path, mbit: float, picture: Path | None) -> None:
    """Print what the first look takes, and the second one, which has the packed map."""
    (dive / NAME).unlink(missing_ok=True)
    for look in ("first", "second"):
        found = measure(dive, mbit, picture and picture.with_stem(f"{picture.stem}_{look}"))
        rounded = {name: round(value, 3) for name, value in found.items()}
        print(json.dumps({"look": look} | rounded), flush=True)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition(":")[0])
    parser.add_argument("dive", type=Path)
    parser.add_argument("--gaussians", type=int, help="a map made for this, in place of the dive's")
    parser.add_argument("--mbit", type=float, default=10.0)
    parser.add_argument("--picture", type=Path, help="keep what is on the screen, by these names")
    given = parser.parse_args()
    if given.gaussians is None:
        looks(given.dive, given.mbit, given.picture)
        return
    with tempfile.TemporaryDirectory() as folder:
        dive = shutil.copytree(given.dive, Path(folder) / "dive")
        for name, splats in zip(("map", "map_clear"), relief(given.gaussians), strict=True):
            write_ply(dive / f"{name}.ply", splats)
        looks(dive, given.mbit, given.picture)


if __name__ == "__main__":
    main()
