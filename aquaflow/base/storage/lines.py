"""Files of lines that are appended to, also after a power cut in the middle of a line."""

from __future__ import annotations

import os
from pathlib import Path

from aquaflow.base.errors.regular_file import open_regular


def is_cut_short(path: Path) -> bool:
    """True if the file's last line has no end."""
    try:
        with open_regular(path) as stream:
            stream.seek(-1, os.SEEK_END)
            return stream.read(1) != b"\n"
    except OSError:  # there is none, or it is empty
        return False
