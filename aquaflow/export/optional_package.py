"""Packages that only some exports need, imported when such an export is asked for."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from aquaflow.errors import InputError


def survey_package(name: str, use: str) -> Any:
    """The module ``name`` of the extra ``survey``; ``use`` says what needs it.

    Raises:
        InputError: it is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise InputError(
            f"{use} needs the package {name}, which is not installed; "
            "run `pip install 'aquaflow[survey]'`"
        ) from error
