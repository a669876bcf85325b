"""A page's section on speed and accuracy: its numbers are written here, not typed."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from aquaflow.base.errors import InputError, reason_of
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.lab.bench.summary import NOTES
from aquaflow.lab.bench.table import failures, features, markdown

BEGIN, END = "<!-- bench: begin -->", "<!-- bench: end -->"
"""Comments between which the results stand."""


def write_readme(
    readme: Path, picture: Path, machine: dict[str, Any], rows: Sequence[dict[str, Any]]
) -> None:
    """Replace what stands between the markers; the picture is copied next to the file.

    Raises:
        InputError: the file or its markers are not there.
    """
    before, after = around_section(readme)
    kept = readme.resolve().parent / picture.name
    if kept != picture.resolve():
        shutil.copyfile(picture, kept)
    middle = section(kept.name, machine, rows)
    with atomic_write(readme) as stream:
        stream.write(f"{before}{BEGIN}\n{middle}\n{END}{after}".encode())


def around_section(readme: Path) -> tuple[str, str]:
    """What stands before and after the section; to be asked before hours of measuring.

    Raises:
        InputError: the file or its markers are not there.
    """
    try:
        text = readme.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"cannot read {readme}: {reason_of(error)}; give a Markdown file"
        ) from error
    before, begun, rest = text.partition(BEGIN)
    _, ended, after = rest.partition(END)
    if not begun or not ended or text.count(BEGIN) != 1 or text.count(END) != 1:
        raise InputError(f"{readme} needs the lines '{BEGIN}' and '{END}' once each, in this order")
    return before, after


def section(picture: str, machine: dict[str, Any], rows: Sequence[dict[str, Any]]) -> str:
    """Markdown: picture, table, how to read it, and what it ran on."""
    failed = [f"- {sentence}" for sentence in failures(rows)]
    parts = [
        f"![Run time per frame against trajectory error and against picture quality]({picture})",
        markdown(rows),
        " ".join((*features(rows), *NOTES)),
        "\n".join(failed),
        describe_machine(machine, rows),
    ]
    return "\n\n".join(part for part in parts if part)


def describe_machine(machine: dict[str, Any], rows: Sequence[dict[str, Any]]) -> str:
    """One paragraph on the machine, its load, the versions and the date."""
    loads = [row["load"] for row in rows if row["load"] is not None]
    busy = f" Load while it ran: {min(loads):.1f} to {max(loads):.1f}." if loads else ""
    gpu = f" GPU: {machine['gpu']}." if machine["gpu"] else ""
    packages = ", ".join(f"{name} {found}" for name, found in machine["packages"].items() if found)
    repeats = 1 + max(row["repeat"] for row in rows)
    times = "once" if repeats == 1 else f"{repeats} times, interleaved; medians ± half the range"
    return (
        f"Written by `aquaflow lab bench` on {machine['date']}; every run {times}. Machine: "
        f"{machine['processor']}, {machine['cores']} cores, {machine['memory_gb']} GB, "
        f"{machine['system']}.{gpu}{busy} AquaFlow {machine['aquaflow']}, Python "
        f"{machine['python']}, {packages}."
    )
