"""`aquaflow lab batch --cluster` on a real Ray cluster of two nodes, parts of which are killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from aquaflow.base.errors import InputError
from aquaflow.lab.batch import ray_workers
from aquaflow.lab.batch.ray_workers import RayWorkers
from aquaflow.survey.site.merging import add_to_site, merge
from tests.lab.batch.ray_cluster import two_nodes
from tests.lab.batch.seasons import (
    SHORT,
    contents,
    events,
    install_poison,
    leftovers,
    season,
    wait_for,
)
from tests.survey.site.site_dives import Scene, stated_dive

AQUAFLOW = str(Path(sys.executable).with_name("aquaflow"))


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """Of the nodes and the command: a source whose recordings can be held."""
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'aquaflow[cluster]'")
    package = install_poison(tmp_path / "poison")
    path = os.pathsep.join([str(package), os.environ.get("PYTHONPATH", "")])
    return dict(os.environ) | {"PYTHONPATH": path}


@pytest.fixture
def dives(small_recording: Path, tmp_path: Path) -> Path:
    """Three recordings, of which the first attempt at one lasts until it is killed."""
    folder = season(tmp_path / "dives", small_recording, 2)
    (folder / "long.hold").write_text(str(folder / "dive0"))
    return folder


def command(dives: Path, site: Path, *more: str) -> list[str]:
    return [AQUAFLOW, "lab", "batch", str(dives), "--out", str(site), *SHORT, "--json", *more]


def begin(environment: dict[str, str], words: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.mark.slow
def test_a_killed_worker_costs_no_dive_and_the_bytes_are_those_of_one_by_one(
    environment: dict[str, str], dives: Path, tmp_path: Path
) -> None:
    site = tmp_path / "site"
    with two_nodes(environment) as cluster:
        running = begin(environment, command(dives, site, "--cluster", cluster.address))
        worker = int(wait_for(dives / "long.hold-begun"))
        os.kill(worker, signal.SIGKILL)
        said, problem = running.communicate()
    assert running.returncode in (0, 3), problem + said
    assert [line["dive"] for line in events(site, "lost")] == ["long"]
    assert sorted(path.name for path in (site / "dives").glob("[!.]*")) == [
        "dive0", "dive1", "long",
    ]  # fmt: skip
    alone = tmp_path / "alone"
    done = begin(environment, command(dives, alone, "--jobs", "1"))
    done.communicate()
    assert contents(alone) == contents(site)
    assert leftovers(alone) == []


@pytest.mark.slow
def test_a_killed_head_ends_the_batch_in_a_sentence_and_again_it_goes_on(
    environment: dict[str, str], dives: Path, tmp_path: Path
) -> None:
    site = tmp_path / "site"
    with two_nodes(environment) as cluster:
        running = begin(environment, command(dives, site, "--cluster", cluster.address))
        wait_for(dives / "long.hold-begun")
        cluster.head.kill()
        said, problem = running.communicate()
    assert running.returncode == 1
    assert problem == ""
    end = json.loads(said)["end"]
    assert cluster.address in end
    assert "give the same command again" in end
    finished = {path.name for path in (site / "dives").glob("[!.]*")}
    assert "long" not in finished
    with two_nodes(environment) as cluster:
        again = begin(environment, command(dives, site, "--cluster", cluster.address))
        said, problem = again.communicate()
    assert again.returncode in (0, 3), problem + said
    outcomes = json.loads(said)["dives"]
    assert {name for name, each in outcomes.items() if each["earlier"]} == finished
    assert leftovers(site) == []


@pytest.mark.slow
def test_dives_looked_up_on_a_cluster_merge_as_those_looked_up_here(
    environment: dict[str, str], tmp_path: Path
) -> None:
    scene = Scene(1)
    made = [
        stated_dive(tmp_path / name, scene, start=0.2 * seed, seed=seed)
        for seed, name in enumerate("abcd")
    ]
    for site in ("here", "there"):
        add_to_site(tmp_path / site, made)
    with two_nodes(environment) as cluster:
        words = [AQUAFLOW, "site", "merge", str(tmp_path / "there"), "--cluster", cluster.address]
        running = begin(environment, [*words, "--json"])
        said, problem = running.communicate()
    assert running.returncode == 0, problem + said
    assert [line["dive"] for line in events(tmp_path / "there", "done")] == ["b and 2 more"]
    merge(tmp_path / "here")
    for name in ("merged.json", "merged.npy", "joint.npz"):
        found = (tmp_path / "there" / name).read_bytes()
        assert found == (tmp_path / "here" / name).read_bytes()


@pytest.mark.slow
def test_an_address_without_a_cluster_is_told_in_a_sentence(
    environment: dict[str, str], dives: Path, tmp_path: Path
) -> None:
    ran = begin(environment, command(dives, tmp_path / "site", "--cluster", "127.0.0.1:9"))
    said, problem = ran.communicate()
    assert ran.returncode == 1
    assert said == ""
    [line] = problem.splitlines()
    assert "the Ray cluster at 127.0.0.1:9 cannot be used" in line


def test_without_ray_a_cluster_is_refused_with_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(ray_workers, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="aquaflow\\[cluster\\]"):
        RayWorkers("auto")


@pytest.mark.parametrize(
    ("program", "problem"),
    [
        ("", "it ended"),
        ('print(\'{"failed": "no such host"}\')', "no such host"),
        ("import time; time.sleep(60)", "it is silent"),
    ],
)
def test_a_driver_that_dies_fails_or_is_silent_is_a_cluster_that_cannot_be_used(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, program: str, problem: str
) -> None:
    (tmp_path / "no_driver.py").write_text(program)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(ray_workers, "find_spec", lambda name: object())
    monkeypatch.setattr(ray_workers, "PROGRAM", "no_driver")
    monkeypatch.setattr(ray_workers, "JOIN_S", 0.5)
    monkeypatch.setattr(ray_workers, "SILENT_S", 0.5 if problem == "it is silent" else 300.0)
    with pytest.raises(InputError, match=problem):
        RayWorkers("somewhere:1")
