"""``python -m tests.kills --moments 20``: kills every command so often; 1 if anything was wrong."""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.dive import write_dive
from tests.kills.campaign import COMMANDS, attack
from tests.kills.commands import Bench
from tests.small_recording import FRAMES, HEIGHT, WIDTH


def main() -> int:
    """Run the campaign and print a line for each command."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--moments", type=int, default=20)
    parser.add_argument("--seed", type=int, default=40)
    parser.add_argument("--commands", nargs="*", default=COMMANDS)
    asked = parser.parse_args()
    wrong = []
    with tempfile.TemporaryDirectory(prefix="aquaflow-kills-") as folder:
        recording = Path(folder) / "recording"
        write_dive(recording, SyntheticConfig(frames=FRAMES, width=WIDTH, height=HEIGHT))
        bench = Bench(Path(folder), recording)
        for command in asked.commands:
            began_s = time.monotonic()
            tally = attack(bench, command, asked.moments, asked.seed, partial(print, flush=True))
            print(f"{command}: {tally.in_words()}; {time.monotonic() - began_s:.0f} s", flush=True)
            wrong += tally.wrong
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
