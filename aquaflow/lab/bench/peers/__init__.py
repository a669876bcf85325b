"""Other programs on the same frames, listed in the same table as AquaFlow's presets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from aquaflow.config import Config
from aquaflow.lab.bench.peers import sequential_sfm, two_view
from aquaflow.lab.bench.peers.dive import prepared_frames, write_dive
from aquaflow.lab.bench.scene import BenchmarkScene

__all__ = ["PEERS", "run_peer"]

PEERS = {"colmap": sequential_sfm.solve, "two-view": two_view.solve}
"""By the name in the table."""


def run_peer(name: str, scene: BenchmarkScene, config: Config, out: Path) -> dict[str, Any]:
    """Let a peer find the poses of the frames that AquaFlow would map; writes them as a dive.

    Raises:
        AquaFlowError: the peer is not installed, or found no path.
    """
    recording = prepared_frames(scene, config)
    return write_dive(out, recording, PEERS[name](recording.frames))
