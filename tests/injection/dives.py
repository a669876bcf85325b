"""The dives into which faults are brought: what is mapped, by which command, with what config."""

from __future__ import annotations

import http.client
import json
import socket
import threading
import urllib.request
from dataclasses import dataclass
from pathlib import Path
from typing import Any

FEW = {
    "steps_keyframe": 2, "steps_mapping": 2, "steps_common": 1, "refine_steps": 12,
    "heldout_steps": 3, "prune_every": 5,
}  # fmt: skip
QUICK: dict[str, Any] = {
    "lab": True,
    "threads": 1,
    "tracking": {
        "keyframe_share": 0.9,
        "mapping_parallax_widths": 0.02,
        "matches": 800,
        "lost_after": 2,
        "initialisation": {"points": 200, "max_waiting": 6, "pairs": 1, "candidates": 1},
        "graph": {"loop_gap": 2},
        "retrieval": {
            "words": 256, "min_descriptors": 20, "min_similarity": 0.001, "neighbour_share": 0.0,
        },
        "verification": {"min_inliers": 12, "min_inlier_share": 0.4, "min_cells": 2},
    },
    "mapping": {
        "hold_out_every": 5,
        "optimiser": FEW,
        "medium": {"first_fit_views": 4, "fit_views": 6},
    },
}  # fmt: skip
"""Few steps, and thresholds that let 14 small pictures make keyframes, loops and water."""

LEARNED: dict[str, Any] = {
    **QUICK,
    "prior": {"kind": "compact"},
    "mapping": {**QUICK["mapping"], "decoder": {"enabled": True}},
}
ASK_S = 0.05
"""How often the health server is asked."""


@dataclass(frozen=True)
class Dive:
    """One way to map one recording."""

    name: str
    command: str
    source: str
    config: dict[str, Any]

    def prepare(self, recordings: Path, work: Path) -> list[str]:
        """The arguments of ``aquaflow`` for a dive in ``work``, once its config is there."""
        config, out = work / "config.yaml", work / "dive"
        settings = dict(self.config)
        if self.command == "run":
            settings |= {"service": _service(work)}
        config.write_text(json.dumps(settings))
        named = [str(recordings / self.source), "--config", str(config), "--out", str(out)]
        if self.command == "run":
            threading.Thread(
                target=_ask, args=(settings["service"]["health"]["port"],), daemon=True
            ).start()
            return ["run", "--source", *named, "--json", "--speed", "1"]
        return ["map", *named, "--json"]


def _service(work: Path) -> dict[str, Any]:
    return {
        "dives": str(work),
        "health": {"port": _free_port()},
        "mapping": {"steps_per_view": 2, "refine_seconds": None},
        "checkpoint": {"every_s": 0.4},
        "hang_s": 30.0,
    }


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def _ask(port: int) -> None:
    """Ask for every page, again and again, as a ground station does."""
    pause = threading.Event()
    while not pause.wait(ASK_S):
        for page in ("health", "metrics", ""):
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{port}/{page}", timeout=5.0).read()
            except (OSError, http.client.HTTPException):
                continue


DIVES = (
    Dive("map pictures", "map", "pictures", QUICK),
    Dive("map a return", "map", "return", QUICK),
    Dive("map video, learned prior, decoder", "map", "video.avi", LEARNED),
    Dive("map mcap", "map", "mcap", QUICK),
    Dive("run mcap", "run", "mcap", QUICK),
)
"""A site is struck in the first dive of each command that reaches it."""
