"""How long a real browser waits for a dive behind a slow link, and what is sent until then:

    python -m tests.survey.viewer.first_picture DIVE [--gaussians 500000] [--mbit 10]

DIVE is any finished dive; its map is replaced, in a copy, by a textured relief of 20 x 20 m with so
many Gaussians. The browser is a headless Chromium with an empty cache that draws on the processor.
"""

from __future__ import annotations

import argparse
import json
import shutil
import socket
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from aquaflow.config.service import ViewerConfig
from aquaflow.dive.dive import Dive
from aquaflow.dive.ply import PlyGaussians, write_ply
from aquaflow.survey.viewer.finished import finished_dive, prepare, show_dive
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


def measure(dive: Path, mbit: float, picture: Path | None) -> dict[str, float]:
    """Seconds since the address was opened, and megabytes sent by then."""
    began = time.monotonic()
    read = finished_dive(Dive(dive), 10**9)
    page = show_dive(read, ViewerConfig(port=0))
    behind = prepare(dive, read.key, read.packed, read.map, page)
    ready_s = time.monotonic() - began
    link = SlowLink(int(page.address.rstrip("/").rpartition(":")[2]), mbit * 1e6 / 8)
    with tempfile.TemporaryDirectory() as profile:
        browser = Browser(Path(profile) / "profile", webgl=True)
        try:
            browser.emulate(1280, 800)
            opened = time.monotonic()
            browser.open(f"http://127.0.0.1:{link.port}/")
            browser.wait("window.aquaflowTimes?.first")
            if picture is not None:
                browser.screenshot(picture)
            browser.wait("window.aquaflowTimes.whole")
            times = browser.run("return window.aquaflowTimes")
            cost_us = browser.run("return window.aquaflowTimes.cost_us")
        finally:
            browser.close()
            page.close()
            behind.join()
    seconds = {name: times[name] / 1000.0 for name in ("script", "data", "first", "whole")}
    megabytes = {f"{name}_mb": link.until(opened + t_s) / 1e6 for name, t_s in seconds.items()}
    return {"server_ready": ready_s, **seconds, **megabytes, "gaussian_us": cost_us}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition(":")[0])
    parser.add_argument("dive", type=Path)
    parser.add_argument("--gaussians", type=int, default=500_000)
    parser.add_argument("--mbit", type=float, default=10.0)
    parser.add_argument("--picture", type=Path, help="keep what is on the screen first")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        dive = shutil.copytree(given.dive, Path(folder) / "dive")
        for name, splats in zip(("map", "map_clear"), relief(given.gaussians), strict=True):
            write_ply(dive / f"{name}.ply", splats)
        for look in ("first", "second"):  # the second one has the packed map of the first
            found = measure(dive, given.mbit, given.picture)
            rounded = {name: round(value, 3) for name, value in found.items()}
            print(json.dumps({"look": look} | rounded), flush=True)


if __name__ == "__main__":
    main()
