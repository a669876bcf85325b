"""How long a browser waits for a finished dive: from the command to the page and to the map."""

from __future__ import annotations

import time
from importlib.metadata import version
from pathlib import Path
from urllib.request import urlopen

from aquaflow.config.viewer import ViewerConfig
from aquaflow.viewer.finished import read_dive, show_dive

BYTES_OF_A_SPLAT = 32
"""What viser sends of each, uncompressed."""
PATIENCE_S = 60.0
"""After which a viewer that does not answer has failed."""


def viewer_start(dive: Path) -> dict[str, float]:
    """Open the finished ``dive`` as a browser does: seconds on the wall until the first request is
    answered with the page, ``page_s``, and until the map's Gaussians have come, ``map_s``.

    Raises:
        InputError: the dive lacks a file, or viser is not installed.
        OSError: the viewer does not answer.
    """
    began = time.perf_counter()
    config = ViewerConfig(port=0)
    page = show_dive(read_dive(dive, config.splats), config)
    try:
        with urlopen(page.address, timeout=PATIENCE_S) as answer:
            answer.read()
        page_s = time.perf_counter() - began
        _wait_for_map(page.address, page.splats_shown)
        return {"page_s": round(page_s, 3), "map_s": round(time.perf_counter() - began, 3)}
    finally:
        page.close()


def _wait_for_map(address: str, splats: int) -> None:
    """Read what the page's web socket sends until ``splats`` Gaussians must have come."""
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    spoken = Subprotocol(f"viser-v{version('viser')}")
    socket = connect(
        address.replace("http", "ws", 1), subprotocols=[spoken], max_size=None,
        open_timeout=PATIENCE_S,
    )  # fmt: skip
    with socket:
        received = 0
        while received < BYTES_OF_A_SPLAT * splats:
            received += len(socket.recv(timeout=PATIENCE_S))
