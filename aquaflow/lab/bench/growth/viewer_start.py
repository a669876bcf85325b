"""How long a browser waits for a finished dive: from the command to the page and to the map."""

from __future__ import annotations

import json
import time
from pathlib import Path
from urllib.request import urlopen

from aquaflow.config.viewer import ViewerConfig
from aquaflow.dive.dive import Dive
from aquaflow.survey.viewer.finished import finished_dive, show_dive

PATIENCE_S = 60.0
"""After which a viewer that does not answer has failed."""


def viewer_start(dive: Path) -> dict[str, float]:
    """Open the finished ``dive`` as a browser does: seconds on the wall until the first request is
    answered with the page, ``page_s``, and until the map's Gaussians have come, ``map_s``.

    Raises:
        InputError: the dive lacks a file.
        OSError: the viewer does not answer.
    """
    began = time.perf_counter()
    config = ViewerConfig(port=0)
    page = show_dive(finished_dive(Dive(dive), config.splats), config)
    try:
        _get(page.address)
        page_s = time.perf_counter() - began
        about = json.loads(_get(f"{page.address}scene.json"))["map"]
        for number in range(len(about["ends"])):
            _get(f"{page.address}map/{about['version']}/{number}")
        return {"page_s": round(page_s, 3), "map_s": round(time.perf_counter() - began, 3)}
    finally:
        page.close()


def _get(address: str) -> bytes:
    with urlopen(address, timeout=PATIENCE_S) as answer:
        return bytes(answer.read())
