"""Read and map every row of the table of inputs; print the table with its figures.

``python -m tests.recordings.measure_inputs FOLDER [WORDS]``; FOLDER holds a synthetic dive as
``aquaflow lab synth --width 160 --height 120 --frames 24`` writes it, WORDS choose rows.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.recordings.inputs import Row, dive_of
from tests.recordings.inputs.judge import Judge, all_rows


def _line(judge: Judge, row: Row, folder: Path) -> str:
    if row.refuses:
        words = re.sub(r"\S*/", "", judge.refusal(row, folder))
        return f"| {row.name} | refused: {words} | | | |"
    made = judge.made(row, folder)
    return judge.figures(made, folder, judge.read(row, made)).line(row.name)


def main(recording: Path, words: str) -> None:
    """Print a line for each row, also for one that fails."""
    print(
        "| input | frames | grey levels | rotation, degrees | error, ratio |\n|---|---|---|---|---|"
    )
    with TemporaryDirectory() as plain:
        judge = Judge(dive_of(recording), Path(plain))
        for row in all_rows():
            if words in row.name:
                with TemporaryDirectory() as folder:
                    place = Path(folder) / "recording"
                    place.mkdir()
                    try:
                        print(_line(judge, row, place), flush=True)
                    except Exception as error:  # the others are still wanted
                        print(f"| {row.name} | FAILED: {type(error).__name__} {error} | | | |")


if __name__ == "__main__":
    main(Path(sys.argv[1]), " ".join(sys.argv[2:]))
