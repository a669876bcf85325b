"""Optional libraries: loaded when they are needed; an error of one sentence if missing."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from aquaflow.base.errors import InputError


def load(module: str, needed_by: str, extra: str = "telemetry") -> Any:
    """Import ``module``; typed Any, because most such libraries carry no types.

    Raises:
        InputError: it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise InputError(
            f"{needed_by} needs the library {error.name or module}, which is not installed; "
            f"run `pip install 'aquaflow[{extra}]'`"
        ) from error
