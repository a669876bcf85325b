"""The table at the end of a session."""

from __future__ import annotations

from .oracles import DOCUMENTED
from .session import Session


def printed(session: Session) -> str:
    """Runs, exit codes and the slowest run of every command, and how many finds there were."""
    rows = [f"{'command':<22}{'runs':>6}{'slowest s':>11}{'MB':>7}  exit codes (i: after Ctrl-C)"]
    for name, tally in session.tallies.items():
        codes = ", ".join(f"{code}: {count}" for code, count in sorted(tally.codes.items()))
        rows.append(
            f"{name:<22}{tally.runs:>6}{tally.slowest_s:>11.1f}{tally.memory_mb:>7.0f}  {codes}"
        )
    runs = sum(tally.runs for tally in session.tallies.values())
    meanings = "; ".join(f"{code} {meaning}" for code, meaning in DOCUMENTED.items())
    rows.append(f"{runs} runs, {len(session.found)} finds ({meanings})")
    rows += [f"  {session.repeats[signature]:>4} x {signature}" for signature in session.found]
    return "\n".join(rows)
