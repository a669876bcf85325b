"""The kernels' own threads: callers side by side, more parts than cores, threads that come late."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch import Tensor

from aquaflow.render.cpu import CpuRenderer
from aquaflow.render.native import build as native
from tests.render.render_scenes import draw_and_differentiate, random_scene

pytestmark = pytest.mark.skipif(native.find_compiler() is None, reason="no C++ compiler")

THREADS = (1, 2, 7, 31, 64)
"""Far more than cores: most parts are taken by whoever comes first."""


def drawn(threads: int) -> list[Tensor]:
    out, gradients = draw_and_differentiate(CpuRenderer(threads), random_scene(4, n=300))
    return [out.image, out.alpha, *gradients]


def test_who_takes_a_part_does_not_show_in_the_result() -> None:
    wanted = {threads: drawn(threads) for threads in THREADS}
    for _ in range(10):
        for threads in THREADS:  # the number changes from call to call
            assert all(map(torch.equal, drawn(threads), wanted[threads]))


def test_callers_on_several_threads_do_not_disturb_each_other() -> None:
    wanted = {threads: drawn(threads) for threads in THREADS}
    with ThreadPoolExecutor(4) as callers:
        calls = [
            (threads, callers.submit(drawn, threads)) for _ in range(10) for threads in THREADS
        ]
        for threads, call in calls:
            assert all(map(torch.equal, call.result(), wanted[threads]))
