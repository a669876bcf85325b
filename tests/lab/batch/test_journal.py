"""The journal of a batch: every line is whole, whatever ended the batch before."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from aquaflow.lab.batch.season import Journal
from tests.lab.batch.seasons import read_journal

WRITER = """
import sys
from pathlib import Path
from aquaflow.lab.batch.season import Journal
journal = Journal(Path(sys.argv[1]))
print("open", flush=True)
for number in range(10**9):
    journal.write("line", number=number)
    if number == 20:
        print("written", flush=True)
"""


def test_a_killed_writer_leaves_whole_lines_and_the_next_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "batch.jsonl"
    writer = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True
    )
    assert writer.stdout is not None
    assert [writer.stdout.readline() for _ in range(2)] == ["open\n", "written\n"]
    os.kill(writer.pid, signal.SIGKILL)
    writer.communicate()
    before = read_journal(path)
    assert [line["number"] for line in before] == list(range(len(before)))
    assert len(before) > 20
    Journal(path).write("next")
    assert read_journal(path)[-1]["event"] == "next"


def test_half_a_line_is_removed_and_never_joined_to_another(tmp_path: Path) -> None:
    path = tmp_path / "batch.jsonl"
    path.write_bytes(b'{"event": "begun"}\n{"event": "do')
    assert [line["event"] for line in read_journal(path)] == ["begun"]
    Journal(path).write("started", "d1", attempt=2)
    assert [line["event"] for line in read_journal(path)] == ["begun", "started"]
    assert read_journal(path)[1]["dive"] == "d1"


def test_a_disk_that_takes_no_line_costs_that_line_only(tmp_path: Path) -> None:
    path = tmp_path / "batch.jsonl"
    journal = Journal(path)
    journal.write("begun")
    full = os.open("/dev/full", os.O_WRONLY)
    kept = os.dup(journal._stream.fileno())
    os.dup2(full, journal._stream.fileno())
    journal.write("unwritten")
    os.dup2(kept, journal._stream.fileno())
    journal.write("ended")
    assert [line["event"] for line in read_journal(path)] == ["begun", "ended"]
    for each in (full, kept):
        os.close(each)
