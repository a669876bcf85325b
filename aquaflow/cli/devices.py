"""The command that looks for devices: ``devices``. Thin, like all of cli/."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from aquaflow.cli.console import Json, table_console

if TYPE_CHECKING:
    from aquaflow.sources.discovery import DiscoveryResult


def register(app: typer.Typer) -> None:
    """Add the command to ``app``."""
    app.command()(devices)


def devices(
    host: Annotated[
        list[str] | None,
        typer.Option(help="Ask this computer on the network; may be repeated. Else a BlueROV2's."),
    ] = None,
    local: Annotated[
        bool, typer.Option("--local", help="Look at what is plugged in only, not at the network.")
    ] = False,
    as_json: Json = False,
) -> None:
    """List cameras, links and streams that are there, with the lines for the config."""
    from aquaflow.sources.discovery import VEHICLE_HOSTS, discover

    found = discover(() if local else tuple(host or VEHICLE_HOSTS))
    if as_json:
        typer.echo(json.dumps(asdict(found)))
    else:
        _print(found)


def _print(found: DiscoveryResult) -> None:
    from rich.markup import escape
    from rich.table import Table

    console = table_console()
    if found.devices:
        table = Table(box=None, pad_edge=False, padding=(0, 2, 1, 0))
        for heading in ("kind", "found", "what it gives", "for the config"):
            table.add_column(heading, overflow="fold")
        for device in found.devices:
            table.add_row(
                device.kind,
                escape(f"{device.name}\n{device.id}"),
                escape(device.detail),
                escape(_as_yaml(device.config)),
            )
        console.print(table)
    else:
        typer.echo("Nothing was found: no camera, serial port, CAN interface, stream or DVL.")
    for problem in found.problems:
        typer.echo(f"Not looked for: {problem}.")


def _as_yaml(config: dict[str, Any]) -> str:
    import yaml

    if not config:
        return ""
    return str(yaml.safe_dump(config, sort_keys=False)).rstrip()
