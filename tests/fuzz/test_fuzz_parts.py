"""The fuzzer sees what it is there to see: each oracle, each limit, every command."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from .child import Ended, Limits, home_of, run_forked, temporary_of
from .commands import all_commands
from .damage import KINDS, Damage, apply_damage
from .invocations import DAMAGES, invocations
from .loopback import is_here
from .oracles import Contents, Find, contents, finds
from .privileges import own_to_nobody
from .text_damage import HOSTILE_NUMBERS, with_number, with_value

PATIENT = Limits(interrupt_s=None)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    here = tmp_path / "here"
    for each in (here, temporary_of(here), home_of(here)):
        each.mkdir()
    own_to_nobody(tmp_path)
    for above in list(tmp_path.parents)[:2]:
        above.chmod(0o711)  # pytest keeps its folders to its user
    return here


def ended(main: Callable[[], None], folder: Path, limits: Limits = PATIENT) -> Ended:
    return run_forked(main, ["aquaflow"], folder, limits)


def judged(
    end: Ended, folder: Path, before: Contents, argv: tuple[str, ...] = (), out: str = "new"
) -> list[str]:
    found = finds("map", ["aquaflow", *argv], frozenset({out}), folder, before, end)
    return [find.oracle for find in found]


def a_run(code: int = 0, out: str = "", err: str = "") -> Ended:
    return Ended(code, out, err, 0.1, 50.0, interrupted=False, hung=False, orphans=False)


# --- what there is to run ---------------------------------------------------------------------


def test_every_command_of_the_help_is_fuzzed() -> None:
    script = "from aquaflow.cli import app; app()"
    helped = subprocess.run(
        [sys.executable, "-c", script, "--help"], capture_output=True, text=True, check=True
    )
    shown = set(re.findall(r"^\W+([a-z]+)  +[A-Z]", helped.stdout, re.MULTILINE))
    assert {command.words[0] for command in all_commands()} == shown


def test_options_are_known_with_their_types() -> None:
    commands = {command.name: command for command in all_commands()}
    options = {each.name: each for each in commands["map"].parameters}
    assert options["source"].required
    assert options["source"].flags == ()
    assert (options["out"].kind, options["fps"].kind, options["as_json"].kind) == (
        Path,
        float,
        bool,
    )
    assert {"lab prior train compact", "lab bench", "lab bench render", "lab ablate", "run"} <= set(
        commands
    )


@settings(max_examples=20)  # each draws the words of a whole command
@given(st.data())
def test_what_is_drawn_can_be_an_argv(data: st.DataObject) -> None:
    command = data.draw(st.sampled_from(all_commands()))
    drawn = data.draw(invocations(command, ("dive", "recording")))
    assert all("\0" not in argument for argument in drawn.argv)
    assert len(drawn.planted) == len({each.name for each in drawn.planted})


# --- how a run ends -----------------------------------------------------------------------------


def test_exit_codes_and_streams_are_those_of_a_program(folder: Path) -> None:
    def main() -> None:
        print("said")
        print("complained", file=sys.stderr)
        sys.exit(3)

    end = ended(main, folder)
    assert (end.code, end.out, end.err) == (3, "said\n", "complained\n")


def test_an_exception_is_a_traceback_and_exit_code_1(folder: Path) -> None:
    def main() -> None:
        raise ValueError("by design")

    end = ended(main, folder)
    assert end.code == 1
    assert judged(end, folder, {}) == ["traceback"]


def test_a_crash_of_the_interpreter_is_seen(folder: Path) -> None:
    end = ended(os.abort, folder)
    assert end.code == -6
    assert "exit code" in judged(end, folder, {})


def test_a_hang_is_killed_and_says_where_it_was(folder: Path) -> None:
    def endless_loop() -> None:
        while True:
            time.sleep(0.01)

    end = ended(endless_loop, folder, Limits(interrupt_s=None, hang_s=0.3))
    assert end.hung
    assert "endless_loop" in end.err
    assert judged(end, folder, {}) == ["hang"]


def test_a_long_run_gets_a_ctrl_c(folder: Path) -> None:
    def main() -> None:
        try:
            time.sleep(60.0)
        except KeyboardInterrupt:
            sys.exit(130)

    end = ended(main, folder, Limits(interrupt_s=0.2))
    assert (end.code, end.interrupted, end.hung) == (130, True, False)
    assert judged(end, folder, {}) == []


def test_a_process_left_behind_is_seen_and_ended(folder: Path) -> None:
    def main() -> None:
        subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])

    end = ended(main, folder)
    assert end.orphans
    assert judged(end, folder, {}) == ["orphans"]


def test_memory_and_files_are_bounded(folder: Path) -> None:
    def main() -> None:
        with pytest.raises(MemoryError):
            bytearray(100 << 30)
        with pytest.raises(OSError, match="too large"), Path("big").open("wb") as stream:
            stream.truncate(1 << 40)

    assert ended(main, folder).code == 0


@pytest.mark.skipif(os.geteuid() != 0, reason="only root could write where it must not")
def test_nothing_outside_can_be_written(folder: Path) -> None:
    foreign = folder.parent.parent / f"{folder.parent.name}-foreign"
    foreign.write_text("precious")

    def main() -> None:
        for path in (foreign, Path("/dev/new"), Path("/etc/new")):
            with pytest.raises(PermissionError):
                path.write_text("x")
        assert Path("/dev/null").is_char_device()
        Path("new").write_text("x")

    end = ended(main, folder)
    assert (end.code, end.err) == (0, "")
    assert foreign.read_text() == "precious"


def test_other_machines_cannot_be_reached(folder: Path) -> None:
    def main() -> None:
        with pytest.raises(OSError, match="unreachable"):
            socket.create_connection(("192.0.2.1", 80))
        with pytest.raises(socket.gaierror):
            socket.getaddrinfo("example.org", 80)
        with socket.create_server(("127.0.0.1", 0)) as server:
            socket.create_connection(server.getsockname()).close()

    assert ended(main, folder).code == 0
    assert is_here("::1")
    assert not is_here("10.0.0.1")


# --- what is judged -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("end", "argv", "oracle"),
    [
        (a_run(0, "fine"), (), None),
        (a_run(1, err="aquaflow: there is nothing at x\n"), (), None),
        (a_run(2, err="Usage: ..."), (), None),
        (a_run(0, '{"a": 1}'), ("--json",), None),
        (a_run(1), (), "sentence"),
        (a_run(1, err="aquaflow: one\naquaflow: two\n"), (), "sentence"),
        (a_run(1, err="[ERROR:0] a library's own words\n"), (), "sentence"),
        (a_run(4), (), "exit code"),
        (a_run(70, err="aquaflow: a mistake in AquaFlow itself\n"), (), "mistake"),
        (a_run(-11), (), "exit code"),
        (a_run(130), (), "exit code"),
        (a_run(0, '{"a": NaN}'), ("--json",), "json"),
        (a_run(0, "Wrote it."), ("--json",), "json"),
        (a_run(0, err="Exception ignored in: <x>\n"), (), "traceback"),
    ],
)
def test_an_end_is_judged(
    folder: Path, end: Ended, argv: tuple[str, ...], oracle: str | None
) -> None:
    assert judged(end, folder, {}, argv) == ([] if oracle is None else [oracle])


def test_what_is_left_half_written_is_seen(folder: Path) -> None:
    before = contents(folder)
    (folder / ".map.ply.part").write_text("half")
    (folder / "metrics.json").write_text('{"a": ')
    (folder / "whole.json").write_text("{}")
    (temporary_of(folder) / "tmp1").touch()
    assert sorted(judged(a_run(), folder, before)) == ["half-written", "part", "temporary"]


def test_a_changed_input_is_seen_unless_it_is_an_output(folder: Path) -> None:
    (folder / "dive").mkdir()
    (folder / "dive" / "map.ply").write_text("old")
    before = contents(folder)
    assert judged(a_run(), folder, before) == []
    (folder / "dive" / "map.ply").write_text("new")
    assert judged(a_run(), folder, before) == ["changed"]
    assert judged(a_run(), folder, before, out="dive") == []
    (folder / "dive" / "map.ply").unlink()
    assert judged(a_run(), folder, before) == ["changed"]


def test_two_runs_of_one_mistake_have_one_signature() -> None:
    frames = 'File "/a/aquaflow/x.py", line 3\nValueError: 3 is not 4'
    other = 'File "/b/aquaflow/x.py", line 3\nValueError: 5 is not 4'
    assert Find("traceback", frames).signature == Find("traceback", other).signature
    assert Find("hang", frames).signature != Find("traceback", other).signature


# --- damage -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", sorted(set(KINDS) - {"double"}))
def test_every_kind_of_damage_changes_a_file(tmp_path: Path, kind: str) -> None:
    file = tmp_path / "a.yaml"
    file.write_text("width: 160\nlist: [1, 2, 3]\n")
    apply_damage(file, Damage(kind, 0.5, 0.6, 3, "nan"))
    changed = not file.is_file() or file.stat().st_mode & 0o777 == 0
    assert changed or file.read_text() != "width: 160\nlist: [1, 2, 3]\n"


@given(DAMAGES, DAMAGES, st.binary(max_size=60) | st.just(b'{"a": [1, {"b": 2.5}]}'))
def test_any_damage_fits_any_file(first: Damage, second: Damage, content: bytes) -> None:
    with tempfile.TemporaryDirectory() as root:
        for name in ("a.json", "a.bin"):
            (Path(root) / name).write_bytes(content)
        with zipfile.ZipFile(Path(root) / "a.npz", "w") as archive:
            archive.writestr("one", content)
        for damage in (first, second):
            apply_damage(Path(root), damage)


def test_a_number_or_a_value_becomes_another() -> None:
    assert with_number(b"a 1.5, 2", 0.0, "nan") == b"a nan, 2"
    assert with_number(b"a 1.5, 2", 1.0, "") == b"a 1.5, "
    assert json.loads(with_value(b'{"a": {"b": 1}, "c": 2}', 0.99, "true")) == {
        "a": {"b": True}, "c": 2,
    }  # fmt: skip
    for token in HOSTILE_NUMBERS:
        assert with_value(b"a: {b: 1}", 0.0, token)
