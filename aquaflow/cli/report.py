"""The command that writes the report of a finished dive as a PDF: ``report``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from aquaflow.base.errors import InputError
from aquaflow.cli.console import Json

NAME = "report.pdf"
"""In the dive's folder, where no other place is given."""


def register(app: typer.Typer) -> None:
    """Add the command to ``app``."""
    app.command("report")(report)


def report(
    dive: Annotated[Path, typer.Argument(help="Dive folder.")],
    pdf: Annotated[Path | None, typer.Option(help="File; else report.pdf in the dive.")] = None,
    as_json: Json = False,
) -> None:
    """Write the report of a finished dive as one PDF, to print or to send."""
    if pdf is not None and pdf.suffix.lower() != ".pdf":
        raise InputError(f"{pdf} does not end in .pdf; give the report a file of its own")
    from aquaflow.dive.dive import FRAMES, METRICS, Dive
    from aquaflow.survey.report.pdf import write_pdf
    from aquaflow.survey.report.report_of import report_of

    out, of = pdf or dive / NAME, Dive(dive)
    of.require(FRAMES, METRICS)
    pages = write_pdf(out, report_of(of))
    if as_json:
        typer.echo(json.dumps({"pdf": str(out), "pages": pages}))
        return
    typer.echo(f"Wrote {pages} pages to {out}.")
