"""YAML that no one writes in good faith: one sentence, whichever command reads it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.command_line import Cli, refused

MULTIPLYING = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 12)
)
HOSTILE = {
    "an integer of 5,000 digits": "seed: " + "9" * 5000,
    "a hexadecimal integer of 5,000 digits": "seed: 0x" + "9" * 5000,
    "lists nested deeply": "a: " + "[" * 20_000,
    "mappings nested deeply": "a: " + "{b: " * 150 + "1" + "}" * 150,
    "a mapping that contains itself": "source: &a\n  b: *a\n",
    "aliases that multiply": MULTIPLYING,
    "a date that does not exist": "seed: 2001-99-99",
    "half of a surrogate pair": 'source: {crop: "\\ud800"}',
    "no number": "source: {fps: .nan}",
    "infinity": "source: {fps: .inf}",
    "a key that is a list": "? [1, 2]\n: 3\n",
    "a key that is a number": "1: 2\n",
    "more than a megabyte": "# " + "x" * (1 << 20),
}
each_kind = pytest.mark.parametrize("text", HOSTILE.values(), ids=HOSTILE.keys())


@each_kind
def test_a_config_is_refused_with_its_name(command: Cli, tmp_path: Path, text: str) -> None:
    file = tmp_path / "hostile.yaml"
    file.write_text(text)
    refused(command("config", file), file)


@each_kind
def test_a_calibration_is_refused_with_its_name(
    command: Cli, pictures: Path, tmp_path: Path, text: str
) -> None:
    file = tmp_path / "hostile.yaml"
    file.write_text(text)
    ran = command("map", pictures, "--calib", file, "--out", tmp_path / "out")
    refused(ran, file)
    assert not (tmp_path / "out").exists()


@each_kind
def test_a_list_of_logs_is_refused_with_its_name(command: Cli, tmp_path: Path, text: str) -> None:
    (tmp_path / "dive").mkdir()
    (tmp_path / "dive" / "replay.yaml").write_text(text)
    ran = command("record", "--source", tmp_path / "dive", "--out", tmp_path / "out")
    refused(ran, "replay.yaml")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command_line", [("run", "--config"), ("record", "--config")])
def test_a_vehicles_config_is_refused_with_its_name(
    command: Cli, tmp_path: Path, command_line: tuple[str, ...]
) -> None:
    file = tmp_path / "hostile.yaml"
    file.write_text(HOSTILE["a mapping that contains itself"])
    refused(command(*command_line, file), file, "source")


def test_a_config_that_is_not_text_is_refused(command: Cli, tmp_path: Path) -> None:
    file = tmp_path / "hostile.yaml"
    file.write_bytes(b"seed: \xff\xfe\x00")
    refused(command("config", file), file, "not text")


def test_anchors_that_repeat_a_setting_are_read(command: Cli, tmp_path: Path) -> None:
    file = tmp_path / "plain.yaml"
    file.write_text("source: &a {every: 2}\ntracking: {gate: {}}\n")
    ran = command("config", file)
    assert ran.code == 0
    assert "every: 2" in ran.out


# --- replay.yaml ----------------------------------------------------------------------------------


@pytest.mark.parametrize("starts_s", [".nan", ".inf", "1e300", "1e18", "-1e12"])
def test_a_log_cannot_begin_at_a_time_that_no_clock_shows(
    command: Cli, pictures: Path, tmp_path: Path, starts_s: str
) -> None:
    (pictures / "log.nmea").write_text("$SDDBT,1.0,f,0.3,M,0.2,F*00\n")
    manifest = "camera: ../pictures\ntelemetry: [{file: ../pictures/log.nmea, starts_s: %s}]\n"
    (tmp_path / "dive").mkdir()
    (tmp_path / "dive" / "replay.yaml").write_text(manifest % starts_s)
    for name in ("run", "record"):
        ran = command(name, "--source", tmp_path / "dive", "--out", tmp_path / "out")
        refused(ran, "replay.yaml", "starts_s")
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("text", ["camera: .\n", "camera: ../other\n", "telemetry: [{file: .}]\n"])
def test_lists_of_logs_that_name_each_other_are_refused(
    command: Cli, tmp_path: Path, text: str
) -> None:
    for name in ("dive", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "replay.yaml").write_text(text.replace("other", "dive"))
    ran = command("record", "--source", tmp_path / "other", "--out", tmp_path / "out")
    refused(ran, "replay.yaml", "of its own")


# --- camera.yaml ----------------------------------------------------------------------------------

CAMERA = {
    "width": 160, "height": 120, "fx": 136.0, "fy": 136.0, "cx": 80.0, "cy": 60.0,
    "distortion_model": "radtan", "distortion": [0.0, 0.0, 0.0, 0.0],
}  # fmt: skip


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("cx", ".nan"),
        ("cx", ".inf"),
        ("cx", "1e300"),
        ("fx", "1e-300"),
        ("fy", "1e300"),
        ("width", "99999999999999"),
        ("distortion", "[0.1, 0.2]"),
        ("distortion", "[0.1, 0.2, 0.0, 0.0, 0.0, 0.0]"),
        ("distortion", "[.nan, 0, 0, 0]"),
        ("distortion", "[1e300, 0, 0, 0]"),
    ],
)
def test_a_calibration_of_no_camera_is_refused_with_the_key(
    command: Cli, pictures: Path, tmp_path: Path, key: str, value: str
) -> None:
    file = tmp_path / "camera.yaml"
    file.write_text("".join(f"{name}: {each}\n" for name, each in (CAMERA | {key: value}).items()))
    ran = command("map", pictures, "--calib", file, "--out", tmp_path / "out", "--tracking-only")
    refused(ran, key)


def test_a_fisheye_takes_four_coefficients(command: Cli, pictures: Path, tmp_path: Path) -> None:
    file = tmp_path / "camera.yaml"
    camera = CAMERA | {"distortion_model": "fisheye", "distortion": [0.0] * 5}
    file.write_text("".join(f"{name}: {each}\n" for name, each in camera.items()))
    refused(command("map", pictures, "--calib", file, "--out", tmp_path / "o"), file, "fisheye")
