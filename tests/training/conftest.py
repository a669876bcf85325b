"""Training's tensors are small in tests: torch on one thread is several times faster."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch


@pytest.fixture(autouse=True, scope="package")
def one_thread_for_training() -> Iterator[None]:
    """Before the first scene is rendered."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
