"""Links of two dives on disk, so that a merge which was cut off, or gets one dive more, goes on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.base.errors.regular_file import read_regular_json
from aquaflow.base.storage.atomic import make_subfolder, write_json
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.site.links import CrossLink
from aquaflow.survey.site.manifest import SiteDive

FOLDER = "links"
"""In a site."""
METHOD = 2
"""Raised whenever the same dives would give other links."""


def link_file(site: Path, a: SiteDive, b: SiteDive) -> Path:
    """Of the links between two dives."""
    return site / FOLDER / f"{a.fingerprint[:16]}_{b.fingerprint[:16]}.json"


def write_links(path: Path, a: SiteDive, b: SiteDive, links: list[CrossLink]) -> None:
    """Write the links between two dives, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    try:
        make_subfolder(path.parent)
    except OSError as error:
        raise InputError(f"cannot make {path.parent}: {error.strerror}; make room") from error
    write_json(path, {"of": _of(a, b), "links": [_to_json(link) for link in links]})


def read_links(path: Path, a: SiteDive, b: SiteDive) -> list[CrossLink] | None:
    """The links between two dives as they are now; None where they are to be looked for."""
    try:
        data = read_regular_json(path, folders=1)
        if data["of"] != _of(a, b):
            return None
        return [_of_json(stated) for stated in data["links"]]
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _of(a: SiteDive, b: SiteDive) -> list[Any]:
    return [METHOD, a.fingerprint, b.fingerprint]


def _to_json(link: CrossLink) -> dict[str, Any]:
    T = link.T_ba
    return {
        "a": link.a, "b": link.b, "R": T.R.tolist(), "t": T.t.tolist(), "scale": float(T.scale),
        "information": link.information.tolist(), "inliers": link.inliers,
        "matched": link.matched, "cells": link.cells, "similarity": link.similarity,
    }  # fmt: skip


def _of_json(stated: dict[str, Any]) -> CrossLink:
    T = Sim3(np.array(stated["R"]), np.array(stated["t"]), float(stated["scale"]))
    information = np.array(stated["information"], np.float64)
    if T.R.shape != (3, 3) or T.t.shape != (3,) or information.shape != (7, 7):
        raise ValueError("it is no link")
    inliers, matched, cells = (int(stated[name]) for name in ("inliers", "matched", "cells"))
    return CrossLink(
        int(stated["a"]), int(stated["b"]), T, information, inliers, matched, cells,
        float(stated["similarity"]),
    )  # fmt: skip
