"""Names of white balances that restored colours can be shown in."""

from __future__ import annotations

CAMERA = "camera"
NEUTRAL = "neutral"
"""That of the camera for what was nearest, and that in which the light of the restored scene is
grey."""
DAYLIGHT = "daylight"
"""That in which daylight is grey that came down through the dive's water; with a colon and a type
after it, through such water."""
JERLOV_TYPES = (
    "oceanic_I", "oceanic_IA", "oceanic_IB", "oceanic_II", "oceanic_III",
    "coastal_1C", "coastal_3C", "coastal_5C", "coastal_7C", "coastal_9C",
)  # fmt: skip
"""Jerlov's water types, the clearest first."""


def white_balance_named(text: str) -> str | None:
    """The name as it is spelt, whatever the case of ``text``; None where it is none.

    Raises:
        ValueError: it names a water type that there is not.
    """
    names = (CAMERA, NEUTRAL, DAYLIGHT, *(f"{DAYLIGHT}:{water}" for water in JERLOV_TYPES))
    found = {name.lower(): name for name in names}.get(text.strip().lower())
    if found is None and text.strip().lower().startswith(DAYLIGHT):
        raise ValueError(
            f"{text[:80]!r} names no water type of Jerlov's; give {DAYLIGHT}, or {DAYLIGHT}: and "
            f"one of {', '.join(JERLOV_TYPES)}"
        )
    return found


def require_name(text: str) -> str:
    """The name, for a configuration.

    Raises:
        ValueError: it is none.
    """
    found = white_balance_named(text)
    if found is None:
        raise ValueError(
            f"names no white balance; give {CAMERA}, {NEUTRAL}, {DAYLIGHT}, or {DAYLIGHT}:TYPE "
            f"(such as {DAYLIGHT}:oceanic_II)"
        )
    return found
