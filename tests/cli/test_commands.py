"""Every command as a user types it: what it prints, and what it leaves alone."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import yaml

from aquaflow import __version__
from aquaflow.cli import COMMANDS, HELP, OLD_NAMES, console
from aquaflow.config import Config, load_config
from tests.command_line import Cli, refused
from tests.small_recording import FRAMES, HASTY


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_version_is_the_packages(aquaflow: Cli) -> None:
    assert aquaflow("--version").out.strip() == __version__


def test_without_a_command_the_help_is_shown(aquaflow: Cli) -> None:
    ran = aquaflow()
    assert "map" in ran.out + ran.err
    assert "measure" in ran.out + ran.err


@pytest.mark.parametrize(("old", "new"), OLD_NAMES.items(), ids=" ".join)
def test_an_old_name_does_the_same_and_one_sentence_on_stderr_says_todays(
    aquaflow: Cli, old: tuple[str, ...], new: tuple[str, ...]
) -> None:
    asked, today = aquaflow(*old, "--help"), aquaflow(*new, "--help")
    assert (asked.code, asked.out) == (0, today.out)
    assert asked.err == f"'aquaflow {' '.join(old)}' is now 'aquaflow {' '.join(new)}'\n"
    assert today.err == ""


def test_an_old_name_leaves_json_alone(aquaflow: Cli, tmp_path: Path) -> None:
    ran = aquaflow("synth", tmp_path / "s", "--frames", 2, "--width", 64, "--height", 48, "--json")
    assert json.loads(ran.out)["frames"] == 2
    assert ran.err == "'aquaflow synth' is now 'aquaflow lab synth'\n"


def test_the_help_shows_each_group_in_one_line_and_no_old_name(aquaflow: Cli) -> None:
    shown = re.findall(r"^\W+([a-z]+) {2,}([A-Z].*?\.) *\W?$", aquaflow("--help").out, re.MULTILINE)
    assert [name for name, _ in shown] == COMMANDS
    lines = [line for commands in HELP.values() for _, line in commands.values()]
    assert [line for _, line in shown] == lines


@pytest.mark.parametrize("group", ["run", "export", "measure", "doctor", "lab bench"])
def test_a_group_that_is_a_command_names_the_commands_below_it(aquaflow: Cli, group: str) -> None:
    below = [" ".join(new) for new in OLD_NAMES.values() if " ".join(new[:-1]) == group]
    shown = " ".join(aquaflow(*group.split(), "--help").out.split())
    assert f"Usage: aquaflow {group} [OPTIONS]" in shown
    assert all(f"{name}: " in shown for name in below)


def test_a_folder_with_the_name_of_a_command_is_given_by_its_path(
    aquaflow: Cli, tmp_path: Path
) -> None:
    (tmp_path / "video").mkdir()
    refused(aquaflow("export", tmp_path / "video", "--format", "spz"), "video")
    assert aquaflow("export", "video", "--format", "spz").code == 2


def test_without_a_terminal_lines_say_how_far_a_dive_is_and_what_is_left_of_all(
    command: Cli, small_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console, "LINE_S", 0.01)
    ran = command("map", small_recording, *HASTY, "--out", tmp_path / "dive")
    assert ran.code == 0
    said = [line for line in ran.err.splitlines() if line.startswith(("map: ", "refine: "))]
    assert {line.partition(":")[0] for line in said} == {"map", "refine"}
    form = r"(map|refine): \d+ of \d+(; (about (\d+ h )?\d+ min|less than a minute) left)?"
    assert all(re.fullmatch(form, line) for line in said)
    assert said[-1].endswith(" left")


def test_config_prints_yaml_that_loads_back(aquaflow: Cli, tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(aquaflow("config").out)
    assert load_config(file) == Config.model_validate({})


def test_config_completes_a_file(aquaflow: Cli, tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("mapping:\n  max_gaussians: 2000\n")
    shown = yaml.safe_load(aquaflow("config", file).out)
    assert shown["mapping"]["max_gaussians"] == 2000
    assert shown["source"]["every"] == 1


def test_options_come_before_the_config_file(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("seed: 3\nsource:\n  every: 2\n  stop: 9\n")
    dive = tmp_path / "dive"
    aquaflow(
        "map", small_recording, "--config", file, "--stop", 12, "--tracking-only", "--out", dive
    )
    used = load_config(dive / "config.yaml")
    assert (used.seed, used.source.every, used.source.stop) == (3, 2, 12)
    assert not used.mapping.enabled


def test_map_as_json_prints_one_object_and_nothing_else(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    dive = tmp_path / "dive"
    ran = aquaflow("map", small_recording, "--out", dive, "--stop", 10, *HASTY, "--json")
    printed = json.loads(ran.out)
    assert ran.err == ""
    assert printed.pop("dive") == str(dive)
    assert printed == json.loads((dive / "metrics.json").read_text())


def test_synth_and_doctor_as_json_print_one_object(aquaflow: Cli, tmp_path: Path) -> None:
    small = ("--frames", 2, "--width", 64, "--height", 48)
    ran = aquaflow("lab", "synth", tmp_path / "s", *small, "--json")
    assert json.loads(ran.out)["frames"] == 2
    assert ran.err == ""
    assert json.loads(aquaflow("doctor", "--json").out)


def test_map_says_what_came_out_and_where_to_look(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    dive = tmp_path / "dive"
    ran = aquaflow("map", small_recording, "--out", dive, "--stop", 10, *HASTY)
    assert "10 of 10 frames posed" in ran.out
    assert str(dive / "report.html") in ran.out


def test_tracking_only_names_no_map_that_was_not_made(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    dive = tmp_path / "dive"
    ran = aquaflow("map", small_recording, "--out", dive, "--tracking-only")
    assert ran.code == 0
    assert (dive / "trajectory.tum").is_file()
    assert not (dive / "map.ply").exists()
    assert "map.ply" not in ran.out


def test_overwrite_leaves_nothing_of_the_dive_before(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    dive = tmp_path / "dive"
    aquaflow("map", small_recording, "--out", dive, *HASTY)
    assert (dive / "heldout" / "000016_real.png").is_file()
    ran = aquaflow(
        "map", small_recording, "--out", dive, "--stop", 12, "--tracking-only", "--overwrite"
    )
    assert ran.code == 0
    assert not list(dive.glob("*.ply"))
    assert not (dive / "heldout" / "000016_real.png").exists()


@pytest.mark.parametrize("truth", ["poses.tum", "."])
def test_evaluate_prints_one_object_and_changes_nothing(
    aquaflow: Cli, small_recording: Path, small_dive: Path, truth: str
) -> None:
    before = contents(small_dive)
    ran = aquaflow("lab", "evaluate", small_dive, "--truth", small_recording / truth, "--json")
    assert ran.err == ""
    result = json.loads(ran.out)
    assert result["posed"] == FRAMES
    assert result["ate_pct_sim3"] < 2.0
    assert (result["medium_error"] is None) == (truth == "poses.tum")
    assert contents(small_dive) == before


def test_evaluate_against_a_table_of_positions(
    aquaflow: Cli, small_recording: Path, small_dive: Path, tmp_path: Path
) -> None:
    poses = [
        line.split() for line in (small_recording / "poses.tum").read_text().splitlines() if line
    ]
    table = tmp_path / "positions.csv"
    rows = [f"{i:06d}.png,{pose[1]},{pose[2]}" for i, pose in enumerate(poses)]
    table.write_text("\n".join(["file,easting_m,northing_m", *rows]) + "\n")
    result = json.loads(aquaflow("lab", "evaluate", small_dive, "--truth", table, "--json").out)
    assert result["matched"] == FRAMES
    # The heights that the table lacks are part of what is missed.
    assert result["ate_pct_sim3"] < 10.0


def test_evaluate_for_people_names_what_was_measured(
    aquaflow: Cli, small_recording: Path, small_dive: Path
) -> None:
    against = ("--truth", small_recording, "--clean", small_recording)
    ran = aquaflow("lab", "evaluate", small_dive, *against)
    assert f"{FRAMES} of {FRAMES} frames" in ran.out
    for part in ("Trajectory", "Held-out views", "Water", "What is nearest", "Without water"):
        assert part in ran.out
    assert "{" not in ran.out


def test_evaluate_needs_no_truth_for_the_colours_of_restored_views(
    aquaflow: Cli, small_dive: Path
) -> None:
    result = json.loads(aquaflow("lab", "evaluate", small_dive, "--json").out)
    assert list(result) == ["naturalness"]
    assert result["naturalness"]["views"] == 2
    assert "lightness ratio" in aquaflow("lab", "evaluate", small_dive).out
