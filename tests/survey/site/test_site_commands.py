"""``aquaflow site``: what its commands say, and their exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from aquaflow.cli import site as site_commands
from aquaflow.lab.batch import ray_workers, workers
from aquaflow.lab.batch.job import BatchOutcome, Job
from aquaflow.lab.batch.run_job import RunningProcesses
from aquaflow.lab.batch.season import JOURNAL
from tests.command_line import Cli
from tests.lab.batch.seasons import read_journal
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


@pytest.mark.parametrize(("at_once", "jobs"), [(1, ["b", "c"]), (60, ["b and 1 more"])])
def test_look_ups_by_other_processes_give_the_same_merge(
    command: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at_once: int, jobs: list[str]
) -> None:
    monkeypatch.setattr(site_commands, "KEYFRAMES_AT_ONCE", at_once)
    scene = Scene(1)
    dives = [
        stated_dive(tmp_path / name, scene, start=0.2 * seed, count=3, seed=seed)
        for seed, name in enumerate("abc")
    ]
    alone, together = tmp_path / "alone", tmp_path / "together"
    for site in (alone, together):
        command("site", "add", site, *dives)
    command("site", "merge", alone)
    said = command("site", "merge", together, "--jobs", "2", "--json")
    assert [each["dives"] for each in json.loads(said.out)["components"]] == [["a", "b", "c"]]
    events = [(each["event"], each.get("dive")) for each in read_journal(together / JOURNAL)]
    assert sorted(name for event, name in events if event == "done" and name) == jobs
    assert (together / "merged.json").read_bytes() == (alone / "merged.json").read_bytes()
    assert (together / "joint.npz").read_bytes() == (alone / "joint.npz").read_bytes()
    assert command("site", "merge", together, "--jobs", "2").code == 0, "nothing is left to do"


def test_a_look_up_that_fails_elsewhere_is_said_and_done_by_the_merge(
    command: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(job: Job, started: RunningProcesses | None = None) -> BatchOutcome:
        return BatchOutcome("failed", "its disk broke")

    monkeypatch.setattr(workers, "run_job", lost)
    scene, site = Scene(1), tmp_path / "site"
    dives = [stated_dive(tmp_path / n, scene, count=3, seed=s) for s, n in enumerate("ab")]
    command("site", "add", site, *dives)
    said = command("site", "merge", site, "--jobs", "1")
    assert said.code == 0
    assert "b failed elsewhere and is done here: its disk broke" in said.err
    assert "Component 0: a, b" in said.out


def test_a_cluster_that_is_gone_is_told_in_a_sentence_and_merges_nothing(
    command: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "no_driver.py").write_text('print(\'{"failed": "no such host"}\')')
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(ray_workers, "find_spec", lambda name: object())
    monkeypatch.setattr(ray_workers, "PROGRAM", "no_driver")
    scene, site = Scene(1), tmp_path / "site"
    dives = [stated_dive(tmp_path / n, scene, count=3, seed=s) for s, n in enumerate("ab")]
    command("site", "add", site, *dives)
    refused = command("site", "merge", site, "--cluster", "127.0.0.1:9")
    assert refused.code == 1
    [line] = refused.err.splitlines()
    assert "the Ray cluster at 127.0.0.1:9 cannot be used (no such host)" in line
    assert not (site / "merged.json").exists()
