"""How the frames of two dives lie to each other before their surfaces are laid onto each other."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from aquaflow.base.errors import InputError, reason_of
from aquaflow.base.errors.regular_file import read_regular_json
from aquaflow.dive.dive import Dive
from aquaflow.dive.placement import to_geodetic
from aquaflow.geometry.arrays import sim3_from_json
from aquaflow.geometry.earth import north_east
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.site.manifest import SiteDive, read_site
from aquaflow.survey.site.merged_file import PlacedSubMap, merge_of
from aquaflow.telemetry.world_frame import WorldFrame


def T_site_dive(site: Path, dive: SiteDive) -> PlacedSubMap:
    """The main sub-map of a dive in its site.

    Raises:
        InputError: the site was not merged, or not with this dive.
    """
    found = merge_of(site).main_of(dive, site)
    if found is None:
        raise InputError(
            f"the map of {dive.name} is not in the merged site {site}; run `aquaflow site merge "
            f"{site}` again"
        )
    return found


def in_site(site: Path, first: str, second: str) -> tuple[Path, Path, Sim3]:
    """Two dives of a site: their folders, and what maps the second's world m to the first's.

    Raises:
        InputError: the site has no such dives, or they never met.
    """
    dives = {dive.name: dive for dive in read_site(site)}
    for name in (first, second):
        if name not in dives:
            raise InputError(f"{site} has no dive {name!r}; it has {', '.join(dives) or 'none'}")
    a, b = (T_site_dive(site, dives[name]) for name in (first, second))
    if a.component != b.component:
        raise InputError(
            f"{first} and {second} share no place that the merged site knows of; compare dives "
            "that met, or give --transform with two dive folders"
        )
    folders = [dives[name].folder(site) for name in (first, second)]
    return folders[0], folders[1], a.T_sm.inverse() @ b.T_sm


def between(first: Path, second: Path, transform: Path | None) -> Sim3:
    """What maps the world m of the second dive to that of the first.

    Args:
        transform: of n, in which all files of a dive are, from the second dive to the first; None:
            by what both know of the earth, else n is one frame, as of a dive that was mapped in
            another's.

    Raises:
        InputError: a file cannot be read.
    """
    one, other = (Dive(dive).frame for dive in (first, second))
    T_nn = on_earth(one, other) if transform is None else read_transform(transform)
    return one.T_nm.inverse() @ T_nn @ other.T_nm


def on_earth(first: WorldFrame, second: WorldFrame) -> Sim3:
    """From n of the second dive to n of the first; the identity where either has no place."""
    if not (first.georeferenced and second.georeferenced and first.origin and second.origin):
        return Sim3.identity()
    latitude, longitude = to_geodetic(second.origin, np.zeros((1, 3)))
    origin = (first.origin.latitude_deg, first.origin.longitude_deg)
    return Sim3(np.eye(3), np.append(north_east(latitude, longitude, origin)[0], 0.0))


def read_transform(path: Path) -> Sim3:
    """A similarity as metric.json and merged.json have it: ``scale``, ``rotation`` and
    ``translation``.

    Raises:
        InputError: the file cannot be read, or holds none.
    """
    try:
        return sim3_from_json({"scale": 1.0, **read_regular_json(path)})
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"cannot read the transform {path}: {reason_of(error)}; give JSON with scale, "
            "rotation (3 x 3) and translation"
        ) from error
