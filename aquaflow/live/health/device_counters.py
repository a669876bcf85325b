"""What each counter of a device says; a test holds these tables to the drivers' counters."""

from __future__ import annotations

RECEIVED = ("received", "delivered", "bytes", "messages", "samples")
"""What came."""
NOT_ASKED_FOR = ("overtaken", "passed_over")
"""Pictures that tracking had no time for, or was told to leave out."""
DROPPED = ("lost", "stale", "unusable", "duplicates", "dropped_samples")
"""What was lost on its way, or could not be used."""
ERRORS = ("bad_checksums", "garbage_bytes", "invalid_values", "unheard", "stamps_repaired")
"""What came and was not understood, or was corrected."""
RECONNECTS = "reconnects"
