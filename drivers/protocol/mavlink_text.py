"""STATUSTEXT, whole or in MAVLink 2's chunks (mavlink.io/en/messages/common.html#STATUSTEXT)."""

from __future__ import annotations

from typing import Any

from aquaflow.sources.outbound import LONGEST_TEXT, StatusText

SEVERITIES = {"error": 3, "warning": 4, "notice": 5, "info": 6}
"""MAV_SEVERITY."""
MOST_CHUNKS = 5
"""Of one text; what is longer than 249 characters is cut: nobody reads that while steering."""
ALONE = 0
"""``id`` of a text that is whole."""


def text_messages(dialect: Any, outbound: StatusText, number: int) -> list[Any]:
    """One message, or the chunks of a longer text, which ``number`` (1 to 65535) holds together.

    A null character ends a text: one that fills its last chunk is followed by an empty one.
    """
    text = outbound.text.encode("ascii", "replace")
    if len(text) <= LONGEST_TEXT:
        return [_chunk(dialect, outbound, text, ALONE, 0)]
    text = text[: MOST_CHUNKS * LONGEST_TEXT - 1]
    return [
        _chunk(dialect, outbound, text[at : at + LONGEST_TEXT], number, sequence)
        for sequence, at in enumerate(range(0, len(text) + 1, LONGEST_TEXT))
    ]


def _chunk(dialect: Any, outbound: StatusText, text: bytes, number: int, sequence: int) -> Any:
    return dialect.MAVLink_statustext_message(
        severity=SEVERITIES[outbound.severity], text=text, id=number, chunk_seq=sequence
    )
