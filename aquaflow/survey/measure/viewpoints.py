"""Saved views of a dive's map: ``viewpoints.json`` in the dive folder, docs/formats.md#viewpoints.

A view is also what an address of the viewer says after its ``#``; here both forms are read, checked
and written.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlencode

import numpy as np

from aquaflow.base.errors import DamagedError, InputError, reason_of, reason_or_key
from aquaflow.base.errors.regular_file import read_regular_json
from aquaflow.base.storage.atomic import write_json
from aquaflow.geometry.similarity import Sim3
from aquaflow.telemetry.world_frame import WorldFrame

NAME = "viewpoints.json"
FORMAT = 1
"""Raised whenever an older AquaFlow could no longer read the file."""
MOST_VIEWPOINTS, MOST_BYTES = 1000, 1 << 22
"""In one file."""
LONGEST = 100
"""Characters of a name."""
MOST_DIGITS = 4
"""After the point, of coordinates in an address."""
COLOURING = re.compile(r"[a-z]{1,20}")

Numbers = tuple[float, ...]


@dataclass(frozen=True)
class Viewpoint:
    """Where the viewer's eye is, and how it sees the map."""

    key: str
    """Unlike that of every other viewpoint of the dive."""
    name: str
    pose: int | None = None
    """Number of the pose of the path whose place and lens the eye has; None: ``place`` says it."""
    place: Numbers | None = None
    """[3] of the eye in n, in the dive's unit."""
    target: Numbers | None = None
    """[3] of what it turns about."""
    water: float = 0.0
    """Percent, from 0 without the water to 100 as the camera saw it."""
    colours: str = "picture"
    all: bool = False
    """Whether Gaussians that float are shown too."""
    crop: tuple[float | None, ...] | None = None
    """[6] lowest, then highest coordinates of the box that is kept; None in it is an open side."""

    @staticmethod
    def of_link(key: str, name: str, link: str) -> Viewpoint:
        """The view that an address says after its ``#``.

        Raises:
            InputError: it says none.
        """
        said = dict(parse_qsl(link, keep_blank_values=True))
        try:
            crop = [float(side) if side else None for side in said.get("crop", "").split(",")]
            return Viewpoint.of_json({
                "key": key, "name": name, "pose": int(said["pose"]) if "pose" in said else None,
                "place": _numbers(said.get("at")), "target": _numbers(said.get("to")),
                "water": float(said.get("water", 0)), "colours": said.get("colours", "picture"),
                "all": bool(said.get("all")), "crop": crop if "crop" in said else None,
            })  # fmt: skip
        except ValueError as error:
            raise InputError("the view to keep is none; move the eye, and keep it again") from error

    @property
    def link(self) -> str:
        """What an address of the viewer says after its ``#``."""
        eye: dict[str, str] = {} if self.pose is None else {"pose": str(self.pose)}
        if self.place is not None and self.target is not None:
            eye = {"at": _joined(self.place), "to": _joined(self.target)}
        eye |= {"water": f"{self.water:g}"} if self.water else {}
        eye |= {"colours": self.colours} if self.colours != "picture" else {}
        eye |= {"all": "1"} if self.all else {}
        eye |= {"crop": _joined(self.crop)} if self.crop else {}
        return urlencode(eye, safe=",")

    def to_json(self) -> dict[str, Any]:
        """The viewpoint by the names of the file."""
        return {
            "key": self.key, "name": self.name, "pose": self.pose, "place": self.place,
            "target": self.target, "water": self.water, "colours": self.colours,
            "all": self.all, "crop": self.crop,
        }  # fmt: skip

    @staticmethod
    def of_json(said: dict[str, Any]) -> Viewpoint:
        """Read :meth:`to_json`.

        Raises:
            DamagedError: a field is missing or none.
        """
        pose, water, name = said.get("pose"), said.get("water", 0.0), str(said["name"]).strip()
        place, target, crop = (said.get(field) for field in ("place", "target", "crop"))
        if not 0 < len(name) <= LONGEST:
            raise DamagedError(f"its name has not 1 to {LONGEST} characters")
        if not (_is_pose(pose) if pose is not None else _are(place, 3) and _are(target, 3)):
            raise DamagedError("it has neither a pose nor a place and a target")
        if not _is_number(water) or not 0.0 <= water <= 100.0:
            raise DamagedError("its water is no percentage")
        if not COLOURING.fullmatch(str(said.get("colours", "picture"))):
            raise DamagedError("its colours have no name")
        if crop is not None and not _are([0.0 if v is None else v for v in crop], 6):
            raise DamagedError("its crop has not six sides")
        at_pose = pose is not None
        return Viewpoint(
            str(said["key"]), name, pose, None if at_pose else tuple(place or ()),
            None if at_pose else tuple(target or ()), float(water),
            str(said.get("colours", "picture")),
            said.get("all") is True, None if crop is None else tuple(crop),
        )  # fmt: skip


def write_viewpoints(dive: Path, viewpoints: Sequence[Viewpoint], frame: WorldFrame) -> None:
    """Write all viewpoints of a dive, whose largest sub-map lies in ``frame``; replaces the file.

    Raises:
        InputError: they are too many, or the file cannot be written.
    """
    if len(viewpoints) > MOST_VIEWPOINTS:
        raise InputError(f"a dive holds {MOST_VIEWPOINTS} viewpoints at most; remove some")
    said = [each.to_json() for each in viewpoints]
    write_json(dive / NAME, {"format": FORMAT, "unit": frame.unit, "viewpoints": said})


def read_viewpoints(dive: Path, frame: WorldFrame) -> list[Viewpoint]:
    """The viewpoints of a dive, whose largest sub-map lies in ``frame``; none without such a file.

    Raises:
        InputError: the file cannot be read, or holds something else.
    """
    path = dive / NAME
    try:
        data = read_regular_json(path, most_bytes=MOST_BYTES)
        found = [Viewpoint.of_json(each) for each in data["viewpoints"]]
        if data["unit"] != frame.unit:
            raise DamagedError(f"it is in {data['unit']}, and the dive in {frame.unit}")
        return found
    except FileNotFoundError:
        return []
    except OSError as error:
        raise InputError(f"cannot read {path}: {reason_of(error)}") from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        what = reason_or_key(error)
        raise InputError(f"{path} holds no viewpoints ({what}); correct or remove it") from error


def moved_viewpoints(viewpoints: Sequence[Viewpoint], change: Sim3) -> list[Viewpoint]:
    """Viewpoints of a dive whose n was brought to another by ``change``, as by ``aquaflow measure
    scale``. The box of a crop grows where it is turned; open sides would point elsewhere, so that
    one with them is dropped then."""
    return [_moved(each, change) for each in viewpoints]


def _moved(viewpoint: Viewpoint, change: Sim3) -> Viewpoint:
    place, target = (
        None if at is None else tuple(change.apply(np.array([at]))[0].tolist())
        for at in (viewpoint.place, viewpoint.target)
    )
    moved, crop = replace(viewpoint, place=place, target=target), viewpoint.crop
    if crop is None:
        return moved
    if np.allclose(change.R, np.eye(3)):
        by = [*change.t, *change.t]
        sides = [None if v is None else change.scale * v + t for v, t in zip(crop, by, strict=True)]
        return replace(moved, crop=tuple(sides))
    if None in crop:
        return replace(moved, crop=None)
    box = np.array(crop, np.float64).reshape(2, 3)
    corners = np.stack(np.meshgrid(*box.T), axis=-1).reshape(-1, 3)
    turned = change.apply(corners)
    return replace(moved, crop=(*turned.min(axis=0).tolist(), *turned.max(axis=0).tolist()))


def _numbers(text: str | None) -> list[float] | None:
    return None if text is None else [float(number) for number in text.split(",")]


def _joined(numbers: Sequence[float | None]) -> str:
    return ",".join("" if v is None else f"{round(v, MOST_DIGITS):.12g}" for v in numbers)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value) and abs(value) < 1e12


def _is_pose(value: Any) -> bool:
    return isinstance(value, int) and 0 <= value < 1 << 31


def _are(values: Any, count: int) -> bool:
    return (
        isinstance(values, (list, tuple)) and len(values) == count and all(map(_is_number, values))
    )
