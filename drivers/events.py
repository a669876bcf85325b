"""What happens to devices, as fields of log records: keys of log.jsonl (docs/formats.md#log)."""

from __future__ import annotations

from typing import Literal, TypeAlias

Event: TypeAlias = Literal[
    "waiting",
    "connected",
    "format",
    "lost",
    "reconnected",
    "late",
    "failed",
    "unheard",
    "unused",
    "refused",
]
"""``waiting``: not there, and looked for; ``late``: its pictures show the past; ``unheard``:
another sender's message; ``unused``: what the settings, the device's or ours, make useless;
``refused``: what the device was asked for."""


def about(source: str, event: Event) -> dict[str, dict[str, str]]:
    """``extra`` of a log record about the device ``source``."""
    return {"fields": {"event": event, "source": source}}
