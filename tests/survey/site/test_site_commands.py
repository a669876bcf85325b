"""``aquaflow site``: what its commands say, and their exit codes."""

from __future__ import annotations

import json
from pathlib import Path

from tests.command_line import Cli
from tests.survey.site.site_dives import Scene, stated_dive


def test_a_site_is_made_merged_listed_and_checked(command: Cli, tmp_path: Path) -> None:
    scene = Scene(1)
    dives = [
        stated_dive(tmp_path / "a", scene, count=3),
        stated_dive(tmp_path / "b", scene, start=0.2, count=3, seed=4),
        stated_dive(tmp_path / "far", Scene(2), count=3, seed=5),
    ]
    site = tmp_path / "site"
    added = command("site", "add", site, *dives, "--json")
    assert json.loads(added.out) == {"added": ["a", "b", "far"]}
    assert "already" in command("site", "add", site, dives[0]).out
    unmerged = command("site", "check", site)
    assert unmerged.code == 1
    assert "never merged" in unmerged.out
    merged = json.loads(command("site", "merge", site, "--json").out)
    assert [each["dives"] for each in merged["components"]] == [["a", "b"], ["far"]]
    assert "never met" in command("site", "list", site).out
    listed = json.loads(command("site", "list", site, "--json").out)
    assert [(row["name"], row["components"]) for row in listed["dives"]] == [
        ("a", [0]), ("b", [0]), ("far", [1]),
    ]  # fmt: skip
    assert command("site", "check", site).code == 0
    (dives[1] / "frames.csv").write_text("changed\n")
    found = command("site", "check", site, "--json")
    assert found.code == 1
    assert not json.loads(found.out)["good"]


def test_a_folder_that_is_no_site_is_refused_in_a_sentence(command: Cli, tmp_path: Path) -> None:
    refused = command("site", "merge", tmp_path)
    assert refused.code == 1
    assert refused.err.count("\n") == 1
    assert "is no site" in refused.err
