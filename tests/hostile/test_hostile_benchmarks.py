"""Benchmarks and trainings that cannot be done: said before hours of measuring, or drawn as is."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest
import torch

from aquaflow.base.errors.crash_report import FAILED, MISUSED
from aquaflow.lab.bench.picture import draw
from aquaflow.lab.bench.table import BEGIN, END
from tests.command_line import Cli, refused

FAILED_ROW = {"scene": "reef", "preset": "fast", "peer": None, "repeat": 0, "failed": "no map"}


def test_a_benchmark_whose_runs_all_failed_is_drawn(tmp_path: Path) -> None:
    draw([FAILED_ROW, {**FAILED_ROW, "scene": "wall"}], tmp_path / "bench.png", "all failed")
    assert (tmp_path / "bench.png").stat().st_size > 1000


def test_a_benchmark_of_a_scene_without_frames_is_written(
    aquaflow: Cli, pictures: Path, tmp_path: Path
) -> None:
    out = tmp_path / "bench"
    ran = aquaflow(
        "lab",
        "bench",
        "--scene",
        pictures,
        "--preset",
        "fast",
        "--no-peers",
        "--out",
        out,
        "--json",
    )
    assert ran.code == 0, ran.err
    assert '"failed": ' in (out / "bench.json").read_text()
    assert (out / "bench.png").is_file()


@pytest.mark.parametrize("text", ["# no section\n", f"{END}\n{BEGIN}\n", f"{BEGIN}\n", None])
def test_a_readme_without_its_section_is_refused_before_anything_runs(
    command: Cli, pictures: Path, tmp_path: Path, text: str | None
) -> None:
    readme, out = tmp_path / "README.md", tmp_path / "bench"
    if text is not None:
        readme.write_text(text)
    ran = command("lab", "bench", "--scene", pictures, "--readme", readme, "--out", out)
    refused(ran, readme)
    assert not out.exists()
    assert not (tmp_path / "docs").exists()
    if text is not None:
        assert readme.read_text() == text


# --- priors ---------------------------------------------------------------------------------------


def is_empty(path: Path) -> None:
    path.touch()


def is_text(path: Path) -> None:
    path.write_text("this is no checkpoint\n" * 100)


def is_cut(path: Path) -> None:
    torch.save({"model": {"x": torch.zeros(1000)}}, path)
    path.write_bytes(path.read_bytes()[:2000])


def is_a_pickle(path: Path) -> None:
    path.write_bytes(pickle.dumps({"model": [1, 2]}))


def holds_numbers(path: Path) -> None:
    torch.save({"model": {"x": 1}}, path)


def is_half_an_opcode(path: Path) -> None:
    path.write_bytes(b"\x80\x02cposix\n")


MAKERS = [is_empty, is_text, is_cut, is_a_pickle, holds_numbers, is_half_an_opcode]


@pytest.mark.parametrize("make", MAKERS, ids=lambda make: make.__name__)
def test_a_broken_checkpoint_is_refused_and_nothing_is_written(
    command: Cli, tmp_path: Path, make: object
) -> None:
    file, out = tmp_path / "weights.pth", tmp_path / "prior"
    assert callable(make)
    make(file)
    ran = command("lab", "prior", "export", "mast3r", "--checkpoint", file, "--out", out)
    assert ran.code == 1
    assert "Traceback" not in ran.err
    assert ran.err.splitlines()[-1].startswith(f"aquaflow: {file} ")
    assert not out.exists()


@pytest.mark.parametrize("device", ["cuda:99", "banana", "xla", ""])
def test_training_on_a_device_that_is_not_there_is_refused(
    command: Cli, tmp_path: Path, device: str
) -> None:
    ran = command("lab", "prior", "train", "compact", "--device", device, "--out", tmp_path / "out")
    refused(ran, f"'{device}'", code=FAILED if device == "cuda:99" else MISUSED)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("device", ["banana", "cuda:99"])
def test_timing_on_a_device_that_is_not_there_is_refused(command: Cli, device: str) -> None:
    refused(command("lab", "prior", "bench", "--device", device), "device", code=MISUSED)
