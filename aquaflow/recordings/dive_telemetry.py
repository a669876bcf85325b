"""``telemetry.jsonl`` of a live dive, for a recording of the same dive."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from aquaflow.recordings.telemetry_lines import LONGEST_LINE, TelemetryLines, of_line
from aquaflow.recordings.telemetry_log import TelemetryLog
from aquaflow.types import TelemetrySample

LONGEST_LATENCY_NS = 60 * 1_000_000_000
"""From measurement to arrival; more is another clock: of a recording that was played back live."""


class DiveTelemetry(TelemetryLog):
    """The samples as the dive heard them; times count from the first of them."""

    suffixes = frozenset({".jsonl"})

    @classmethod
    def recognises(cls, path: Path) -> bool:
        if not super().recognises(path):
            return False
        try:
            with path.open("rb") as stream:
                of_line(stream.readline(LONGEST_LINE))
        except (OSError, ValueError):
            return False
        return True

    def samples(self) -> Iterator[TelemetrySample]:
        """Samples in the order of the lines; a damaged line costs itself."""
        # The user names this file, and may name a link.
        lines, first_ns = TelemetryLines(self.path.resolve()), None
        for sample in lines.samples():
            first_ns = sample.t_ns if first_ns is None else first_ns
            t_ns = sample.t_ns - first_ns + round(self.starts_s * 1e9)
            latency_ns = sample.arrival_ns - sample.t_ns
            known = 0 <= latency_ns <= LONGEST_LATENCY_NS
            yield replace(sample, t_ns=t_ns, arrival_ns=t_ns + (latency_ns if known else 0))
        self.notes = (
            [f"{lines.damaged} damaged lines of {self.path.name} were left out"]
            if lines.damaged
            else []
        )
