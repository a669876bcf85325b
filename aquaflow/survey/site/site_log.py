"""``log.jsonl`` of a site: what was done to it, a line each."""

from __future__ import annotations

import json
import logging
from datetime import datetime, timezone
from pathlib import Path

from aquaflow.base.storage.atomic import open_to_append

log = logging.getLogger(__name__)

NAME = "log.jsonl"
"""In a site's folder."""


def say(site: Path, event: str, **facts: str | int) -> None:
    """Append a line; a log that cannot be written costs nothing else."""
    now = datetime.now(timezone.utc).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    line = json.dumps({"utc": now, "event": event, **facts}) + "\n"
    try:
        with open_to_append(site / NAME) as stream:
            stream.write(line.encode())
    except OSError as error:
        log.warning("%s takes no more: %s", site / NAME, error.strerror)
