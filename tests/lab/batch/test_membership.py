"""Dives of a batch become members of its site."""

from __future__ import annotations

import json
from pathlib import Path

from aquaflow.lab.batch.site import Sites, add_members, make_site
from aquaflow.survey.site.manifest import is_site, read_site
from aquaflow.survey.site.merging import add_to_site
from tests.command_line import Cli
from tests.lab.batch.seasons import SHORT, season

SITES = Sites(is_site, add_to_site)


def test_dives_of_a_batch_are_members_of_its_site_once(
    small_recording: Path, tmp_path: Path, command: Cli
) -> None:
    dives, site = season(tmp_path / "dives", small_recording, 1), tmp_path / "site"
    for _ in range(2):
        ran = command("lab", "batch", dives, "--out", site, *SHORT, "--json")
        assert ran.code in (0, 3), ran.err + ran.out
        assert json.loads(ran.out)["notes"] == []
    assert [dive.path for dive in read_site(site)] == ["dives/dive0"]


def test_a_dive_that_cannot_be_recognised_is_told_and_the_folder_of_others_is_left(
    tmp_path: Path,
) -> None:
    site, other = tmp_path / "site", tmp_path / "other"
    make_site(str(site), SITES)
    (site / "dives" / "d").mkdir(parents=True)
    [note] = add_members(str(site), ["d"], SITES)
    assert note.startswith("d is no member of the site: ")
    assert read_site(site) == ()
    other.mkdir()
    (other / "thesis.txt").write_text("mine")
    make_site(str(other), SITES)
    assert [path.name for path in other.iterdir()] == ["thesis.txt"]
    assert add_members(str(other), ["d"], SITES) == []
