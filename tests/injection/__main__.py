"""``python -m tests.injection --all`` or ``--sample N``: the table, and what is broken."""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections import Counter
from pathlib import Path

os.environ.pop("AQUAFLOW_STRICT", None)  # in tests it lets every failure through

from . import harness
from .campaign import carry_out, survey
from .dives import DIVES
from .faults import Kind
from .plan import sampled, tasks_for
from .recordings import write_recordings
from .table import BROKEN, table


def main() -> None:
    asked = _arguments()
    with tempfile.TemporaryDirectory(prefix="injection-") as made:
        work = Path(made)
        recordings = asked.recordings or work / "recordings"
        if not recordings.exists():
            recordings.mkdir(parents=True)
            write_recordings(recordings)
        harness.install()
        dives = [dive for dive in DIVES if asked.dive is None or asked.dive in dive.name]
        reached, before = survey(recordings, work, dives)
        tasks = tasks_for(reached, [Kind(kind) for kind in asked.kinds], asked.seed)
        tasks = [
            task for task in tasks if asked.site is None or asked.site in str(task.strike.site)
        ]
        if asked.sample is not None:
            tasks = sampled(tasks, asked.sample, asked.seed)
        results = carry_out(
            tasks, recordings, before, asked.results or work / "results.jsonl", asked.workers
        )
    found = Counter((command, site.library) for command, site in reached)
    print(table(found, results))
    broken = [result for result in results if result.outcome == BROKEN]
    print("\n".join(result.line() for result in broken))
    sys.exit(1 if broken else 0)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.injection", description=__doc__)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--all", action="store_true", help="every site once for each kind")
    which.add_argument("--sample", type=int, help="so many, spread over libraries and kinds")
    parser.add_argument("--seed", type=int, default=0, help="draws the calls and the sample")
    parser.add_argument("--kinds", nargs="+", default=[kind.value for kind in Kind])
    parser.add_argument("--dive", help="only dives with this in their name")
    parser.add_argument("--site", help="only sites with this in their name")
    parser.add_argument("--workers", type=int, default=2, help="processes at a time")
    parser.add_argument("--recordings", type=Path, help="folder of the recordings, kept")
    parser.add_argument("--results", type=Path, help="file that gets a line for each fault")
    return parser.parse_args()


if __name__ == "__main__":
    main()
