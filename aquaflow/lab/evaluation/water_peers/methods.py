"""The methods by the keys of ``contract.NAMES``."""

from __future__ import annotations

from aquaflow.lab.evaluation.water_peers import grey_world, sea_thru, udcp
from aquaflow.lab.evaluation.water_peers.contract import Method

METHODS: dict[str, Method] = {
    "sea_thru": sea_thru.restore,
    "udcp": udcp.restore,
    "grey_world": grey_world.restore,
}
