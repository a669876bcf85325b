"""Several processes that train one network, each on batches of its own (torchrun).

Gradients are averaged once a step, after all batches of the step were summed up: the exchange then
costs the same however many batches a step has.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor
from torch import distributed as dist


class TrainingProcess:
    """This process among those that train; alone unless torchrun started it."""

    rank = 0
    count = 1
    device = torch.device("cpu")

    @property
    def leads(self) -> bool:
        """True for the one process that writes files."""
        return self.rank == 0

    def average(
        self,
        parameters: Iterable[Tensor],  # [...] each
    ) -> None:
        """Replace every gradient by its mean over the processes."""

    def wait(self) -> None:
        """Until every process is here."""


class DistributedProcess(TrainingProcess):
    """A process that torchrun started, once its group is there."""

    def __init__(self) -> None:
        self.rank, self.count = dist.get_rank(), dist.get_world_size()
        if torch.cuda.is_available():
            self.device = torch.device("cuda", int(os.environ["LOCAL_RANK"]))

    def average(
        self,
        parameters: Iterable[Tensor],  # [...] each
    ) -> None:
        """What one process has no gradient for counts as zero."""
        for parameter in parameters:
            if not parameter.requires_grad:
                continue
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
            dist.all_reduce(parameter.grad)
            parameter.grad /= self.count

    def wait(self) -> None:
        """Until every process is here."""
        dist.barrier()


@contextmanager
def joined_processes() -> Iterator[TrainingProcess]:
    """The processes that torchrun started, or this one alone."""
    if "RANK" not in os.environ:
        alone = TrainingProcess()
        if torch.cuda.is_available():
            alone.device = torch.device("cuda")
        yield alone
        return
    dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
    try:
        yield DistributedProcess()
    finally:
        dist.destroy_process_group()
