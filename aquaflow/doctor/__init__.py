"""``aquaflow doctor``: what this machine has, what AquaFlow will use of it, and what is missing."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from aquaflow.doctor import computer, devices
from aquaflow.doctor import machine as accelerator
from aquaflow.doctor.machine import CheckResult, MachineProbes

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["CheckResult", "MachineProbes", "examine", "print_findings", "to_json"]


def examine(machine: MachineProbes | None = None) -> list[CheckResult]:
    """Look at everything AquaFlow can make use of; never raises for something absent."""
    machine = machine or MachineProbes()
    probes = (
        *(
            computer.processor,
            computer.system,
            computer.memory,
            computer.compiler,
            computer.renderer,
            devices.video,
        ),
        *(devices.cameras, devices.oak, devices.serial, devices.can, computer.disk),
    )
    tried = accelerator.findings(machine)  # first: it times what the first use has to compile
    found = [probe(machine) for probe in probes]
    return [*found, *tried, *computer.findings(machine)]


def to_json(findings: list[CheckResult]) -> dict[str, Any]:
    """Stable keys for ``aquaflow doctor --json``."""
    return {"findings": [{**asdict(finding), "ok": finding.ok} for finding in findings]}


def print_findings(findings: list[CheckResult], console: Console) -> None:
    """A table for people: the finding, what it is used for, what to do."""
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False, padding=(0, 2, 1, 0))
    table.add_column("")
    table.add_column("found", overflow="fold")
    table.add_column("what AquaFlow does", overflow="fold")
    for finding in findings:
        mark = "[green]" if finding.ok else "[yellow]"
        advice = f"\n[yellow]{escape(finding.advice)}[/]" if finding.advice else ""
        table.add_row(
            f"{mark}{escape(finding.name)}[/]",
            escape(finding.found),
            escape(finding.used_for) + advice,
        )
    console.print(table)
