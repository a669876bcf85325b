"""``aquaflow site check``: what of a site is no longer as it was."""

from __future__ import annotations

from pathlib import Path

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.keyframes.place import NAME as PLACES
from aquaflow.survey.site.manifest import SiteDive, read_site, state_of
from aquaflow.survey.site.merged_file import MergedSite, read_merged


def check_site(site: Path) -> list[str]:
    """A sentence for each thing that is not as it should be; none for a site that is whole.

    Every keyframe of every dive is read. Nothing is changed.

    Raises:
        InputError: there is no site, or its own files are damaged.
    """
    dives, merged = read_site(site), read_merged(site)
    found = []
    for dive in dives:
        try:
            found += _of_dive(site, dive, merged)
        except InputError as error:
            found.append(f"{dive.name}: {error}")
    if merged is None:
        found.append("The site was never merged; run `aquaflow site merge`.")
    return found


def _of_dive(site: Path, dive: SiteDive, merged: MergedSite | None) -> list[str]:
    state, folder = state_of(site, dive), dive.folder(site)
    if state == "missing":
        return [f"{dive.name}: {folder} has no {PLACES}; put it back, or map the dive again."]
    found = []
    if state == "changed":
        found.append(f"{dive.name}: {folder} changed since it was added; add it again.")
    places = Dive(folder).places
    for place in places.places:
        places.keypoints(place.number)
    if merged is not None and merged.fingerprints.get(dive.name) != dive.fingerprint:
        found.append(f"{dive.name} is not in the last merge; run `aquaflow site merge`.")
    return found
