"""Fills lists and tables of docs/formats.md from the classes that are written to the files.

    python -m tests.write_formats

A list stands between ``<!-- fields of MODULE.CLASS -->`` and ``<!-- end -->`` and has a line for
each field, or each value of an enumeration, with the text that stands below it in the source; a
table of ``bands`` has a row for each file that a module of rasters describes.
tests/test_formats.py fails where the page holds something else.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from dataclasses import fields
from enum import Enum
from pathlib import Path
from typing import Any

from aquaflow.dive.frames_csv import FRAME_COLUMNS, FrameRow
from aquaflow.survey.export.ortho.grid import NODATA, RasterFile
from aquaflow.types import KINDS, STAMP

PAGE = Path(__file__).resolve().parents[1] / "docs" / "formats.md"
BLOCK = re.compile(r"(<!-- (fields|telemetry|bands) of ([\w.]+) -->\n).*?(<!-- end -->)", re.DOTALL)
WRITTEN_AS = {FrameRow: dict(zip((f.name for f in fields(FrameRow)), FRAME_COLUMNS, strict=True))}
"""Columns that do not have the names of their fields."""


def meanings(described: type[Any]) -> dict[str, str]:
    """By field or value: the string below it; fields without one share that of the next."""
    found: dict[str, str] = {}
    body = ast.parse(inspect.getsource(described)).body[0]
    assert isinstance(body, ast.ClassDef)
    waiting: list[str] = []
    for node in body.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            waiting.append(node.target.id)
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            waiting.append(node.targets[0].id)
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and waiting:
            text = " ".join(str(node.value.value).split()).replace("``", "`").rstrip(".")
            found |= dict.fromkeys(waiting, text)
            waiting = []
    assert not waiting, f"{described.__name__}: nothing says what {waiting} mean"
    return found


def list_of(described: type[Any]) -> str:
    """A line for each text, with the names that share it."""
    written = WRITTEN_AS.get(described, {})
    lines: dict[str, list[str]] = {}
    for name, stated in meanings(described).items():
        text = stated[:1].lower() + stated[1:] if stated[1:2].islower() else stated
        is_value = issubclass(described, Enum)
        shown = described[name].value if is_value else written.get(name, name)
        lines.setdefault(text, []).append(f"`{shown}`")
    return "\n".join([*(f"- {', '.join(names)}: {text}" for text, names in lines.items()), ""])


def table_of_telemetry() -> str:
    """A row for each kind of sample: its own fields, and what they are."""
    lines = ["| kind | fields | meaning |", "|---|---|---|"]
    for kind, sample in KINDS.items():
        own = ", ".join(f"`{f.name}`" for f in fields(sample) if f.name not in STAMP)
        text = " ".join((inspect.getdoc(sample) or "").split()).replace("``", "`").rstrip(".")
        lines.append(f"| `{kind}` | {own} | {text} |")
    return "\n".join([*lines, ""])


def table_of_bands(module: str) -> str:
    """A row for each raster of the module: what its bands are, and how holes are marked."""
    lines = ["| file | bands | type | holes |", "|---|---|---|---|"]
    for raster in vars(importlib.import_module(module)).values():
        if isinstance(raster, RasterFile):
            bands = "; ".join(raster.bands).format(unit="in the unit of lengths")
            kind = ("float32", f"{NODATA:g}") if raster.numbers else ("8 bit", "alpha 0")
            lines.append(f"| `{raster.name}` | {bands} | {kind[0]} | {kind[1]} |")
    return "\n".join([*lines, ""])


def filled(page: str) -> str:
    """The page with its lists and tables as the classes say today."""

    def block(match: re.Match[str]) -> str:
        begin, kind, name, end = match.groups()
        module, _, described = name.rpartition(".")
        if kind == "telemetry":
            table = table_of_telemetry()
        elif kind == "bands":
            table = table_of_bands(name)
        else:
            table = list_of(getattr(importlib.import_module(module), described))
        return f"{begin}\n{table}\n{end}"

    return BLOCK.sub(block, page)


if __name__ == "__main__":
    PAGE.write_text(filled(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
