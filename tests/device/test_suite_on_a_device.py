"""Every scene of the ci suite on the pretended device has the numbers that it has on the CPU."""

from __future__ import annotations

from pathlib import Path

import pytest

from aquaflow.lab.bench.ci_suite import DIMMED, PAUSED, PLAIN
from aquaflow.lab.bench.scene import BenchmarkScene
from tests.device.suite import (
    COMPILED,
    DEVICE,
    PLAIN_TORCH,
    VARIANTS,
    difference,
    map_scene,
    scenes,
)

pytestmark = pytest.mark.slow

WITHIN = {"psnr": 0.02, "ate_pct_sim3": 0.2, "gaussians": 0.02}
"""Relative, of the CPU's compiled kernels, which round otherwise."""
WITHIN_TORCH = {"psnr": 0.005, "ate_pct_sim3": 0.05, "gaussians": 0.005}
"""Of torch on the CPU: some of its gradients are computed otherwise for tensors of a subclass, and
differ in the last bit of a few elements."""
UNMAPPED = {"net, open water"}
"""No frame of it can be placed, wherever the map would be."""


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> dict[str, BenchmarkScene]:
    return {scene.name: scene for scene in scenes(tmp_path_factory.mktemp("ci_suite"))}


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", [*PLAIN, PAUSED, DIMMED])
def test_a_scene_has_the_cpus_numbers_and_nothing_strays(
    suite: dict[str, BenchmarkScene], name: str, variant: str, tmp_path: Path
) -> None:
    there, plain, compiled = (
        map_scene(suite[name], variant, place, tmp_path)
        for place in (DEVICE, PLAIN_TORCH, COMPILED)
    )
    assert there.strays == 0
    if name in UNMAPPED:
        assert {there.numbers["psnr"], plain.numbers["psnr"], compiled.numbers["psnr"]} == {None}
        return
    assert sum(there.moved.values()) > 0
    for wanted, within in ((compiled, WITHIN), (plain, WITHIN_TORCH)):
        for key, tolerance in within.items():
            found = difference(there.numbers, wanted.numbers, key)
            assert found is not None
            assert found < tolerance, key
