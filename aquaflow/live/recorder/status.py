"""What a recorder has done so far."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any


@dataclass
class RecorderStatus:
    """Counts since the recording began."""

    frames: int = 0
    samples: int = 0
    link_bytes: int = 0
    """Raw bytes of links, as received."""
    written_bytes: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    """Messages that did not fit into the queue, or could not be encoded, by topic."""
    files: list[Path] = field(default_factory=list)
    wall_clock_jumps: int = 0
    slowest_flush_s: float = 0.0
    stopped: str | None = None
    """Why recording ended by itself: a sentence."""

    def to_json(self) -> dict[str, Any]:
        """Stable keys, for --json and for the recording itself."""
        return asdict(self) | {"files": [str(file) for file in self.files]}
