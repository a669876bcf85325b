"""Training of any prior: resumable, repeatable, and drawn as a curve while it goes on.

A step's batch follows from the seed and the step's number, so that a run that was stopped and
resumed ends with the same weights as one that was not.
"""

from __future__ import annotations

import json
import logging
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch import distributed as dist

from aquaflow.base.errors import InputError, reason_of
from aquaflow.base.storage.atomic import atomic_write

log = logging.getLogger(__name__)

CHECKPOINT, HISTORY, CURVE = "checkpoint.pt", "history.json", "curve.png"
"""Files of a run."""

Progress = Callable[[str, int, int], None]


class Task(Protocol):
    """What is learnt."""

    @property
    def network(self) -> nn.Module:
        """What is trained."""
        ...

    def loss(self, batch: int) -> tuple[Tensor, dict[str, float]]:
        """Loss of batch number ``batch``, and the terms it is made of."""
        ...

    def validate(self) -> dict[str, float]:
        """Figures on data that is never trained on."""
        ...


@dataclass(frozen=True)
class TrainingPlan:
    """How long and how carefully."""

    schedule: Schedule
    batches: int = 1
    """Of a step, shared out among the processes: the step is the same however many there are."""
    weight_decay: float = 0.01
    betas: tuple[float, float] = (0.9, 0.95)
    longest_gradient: float = 1.0
    """Norm to which gradients are cut."""
    validate_every: int = 500
    """Steps."""
    validate_first: bool = False
    """Figures of the weights that a run starts from too, at step 0."""
    save_every: int = 250
    """Steps; a checkpoint holds all that is needed to go on."""
    hours: float | None = None
    """After which a call stops, to be continued by another; None: when the schedule ends."""


@dataclass
class _Run:
    """What a checkpoint holds."""

    step: int
    cpu_s: float
    history: list[dict[str, float]]


def train(
    task: Task,
    plan: TrainingPlan,
    out: Path,
    progress: Progress,
    process: TrainingProcess | None = None,
) -> list[dict[str, float]]:
    """Train until the schedule or the plan's hours end, from ``out``'s checkpoint if there is one.

    Gradients are summed over all processes, and the one that leads writes files.

    Returns:
        One row per validation: step, cpu_s, rate, the mean training terms and the figures.

    Raises:
        InputError: the checkpoint is of another network.
    """
    process = process or TrainingProcess()
    out.mkdir(parents=True, exist_ok=True)
    optimiser = torch.optim.AdamW(
        task.network.parameters(), lr=0.0, betas=plan.betas, weight_decay=plan.weight_decay
    )
    run = _resume(task.network, optimiser, out / CHECKPOINT)
    began, steps = time.process_time() - run.cpu_s, plan.schedule.steps
    sums: dict[str, list[float]] = {}
    until = math.inf if plan.hours is None else time.monotonic() + 3600.0 * plan.hours
    if process.leads and plan.validate_first and run.step == 0:
        _validate(task, plan, run, sums, out)
    while run.step < steps:
        for name, value in _step(task, optimiser, plan, run.step, process).items():
            sums.setdefault(name, []).append(value)
        run.step += 1
        last, over = run.step == steps, time.monotonic() >= until
        if process.leads and (last or run.step % plan.validate_every == 0):
            run.cpu_s = time.process_time() - began
            _validate(task, plan, run, sums, out)
            sums = {}
        if process.leads and (last or over or run.step % plan.save_every == 0):
            run.cpu_s = time.process_time() - began
            _save(task.network, optimiser, run, out / CHECKPOINT)
        progress("train", run.step, steps)
        if over:
            break
    return run.history


def has_ended(history: list[dict[str, float]], schedule: Schedule) -> bool:
    """Whether the last validation came after the schedule's last step."""
    return bool(history) and history[-1]["step"] >= schedule.steps


def _step(
    task: Task,
    optimiser: torch.optim.Optimizer,
    plan: TrainingPlan,
    step: int,
    process: TrainingProcess,
) -> dict[str, float]:
    """One step of the optimiser; a loss that is no number moves nothing."""
    task.network.train()
    for group in optimiser.param_groups:
        group["lr"] = plan.schedule.rate(step)
    optimiser.zero_grad(set_to_none=True)
    means: dict[str, float] = {}
    parts = range(process.rank, plan.batches, process.count)
    for part in parts:
        loss, terms = task.loss(step * plan.batches + part)
        (loss / plan.batches).backward()  # type: ignore[no-untyped-call]
        for name, value in terms.items():
            means[name] = means.get(name, 0.0) + value / len(parts)
    process.add_up(task.network.parameters())
    norm = nn.utils.clip_grad_norm_(task.network.parameters(), plan.longest_gradient)
    if bool(torch.isfinite(norm)):
        optimiser.step()
    else:
        log.warning("step %d has no finite gradient; left out", step)
    return means


def _validate(
    task: Task, plan: TrainingPlan, run: _Run, sums: dict[str, list[float]], out: Path
) -> None:
    """A row more for the history and its picture."""
    row = {"step": float(run.step), "cpu_s": round(run.cpu_s, 1)}
    row["rate"] = plan.schedule.rate(run.step - 1)
    row |= {f"loss_{name}": sum(values) / len(values) for name, values in sums.items()}
    run.history.append(row | task.validate())
    with atomic_write(out / HISTORY) as stream:
        stream.write(json.dumps(run.history, indent=1).encode() + b"\n")
    draw_curve(run.history, out / CURVE)
    log.info("%s", json.dumps(run.history[-1]))


def _save(network: nn.Module, optimiser: torch.optim.Optimizer, run: _Run, path: Path) -> None:
    state: dict[str, Any] = {
        "step": run.step,
        "cpu_s": run.cpu_s,
        "history": run.history,
        "network": network.state_dict(),
        "optimiser": optimiser.state_dict(),
    }
    with atomic_write(path) as stream:
        torch.save(state, stream)


def _resume(network: nn.Module, optimiser: torch.optim.Optimizer, path: Path) -> _Run:
    if not path.is_file():
        return _Run(0, 0.0, [])
    try:
        state = torch.load(path, weights_only=True, map_location="cpu")
    except Exception as error:  # the unpickler lets through whatever damaged bytes make it do
        raise InputError(
            f"{path} cannot be read as a checkpoint ({reason_of(error)}); give another --out"
        ) from error
    try:
        network.load_state_dict(state["network"])
        optimiser.load_state_dict(state["optimiser"])
    except (KeyError, RuntimeError, ValueError) as error:
        raise InputError(
            f"{path} is the checkpoint of another network; give another --out"
        ) from error
    return _Run(int(state["step"]), float(state["cpu_s"]), list(state["history"]))


# --------------------------------------------------------------------------------------------------
# A picture of how a training goes.

NOT_FIGURES = ("step", "cpu_s", "rate")
"""Keys of the history that are not drawn."""
COLOURS = 10
"""Of lines in one picture; more are dashed, then dotted."""


def draw_curve(history: list[dict[str, float]], path: Path) -> None:
    """Training terms on the left, held-out figures on the right, both over CPU time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 4), layout="constrained")
    axes = figure.subplots(1, 2)
    minutes = [row["cpu_s"] / 60.0 for row in history]
    for name in history[-1]:
        if name in NOT_FIGURES:
            continue
        values = [row.get(name, float("nan")) for row in history]
        loss = name.startswith("loss_")
        axis = axes[0 if loss else 1]
        dashes = ("-", "--", ":")[len(axis.lines) // COLOURS % 3]
        axis.plot(minutes, values, dashes, marker=".", label=name.removeprefix("loss_"))
    for axis, title in zip(axes, ("training loss", "held-out pairs"), strict=True):
        axis.set_title(title)
        axis.set_xlabel("CPU minutes")
        axis.grid(alpha=0.3)
        if axis.lines:
            axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(path, dpi=100)


# --------------------------------------------------------------------------------------------------
# The learning rate over a training: a linear start, then half a cosine (paper, Sec. 4).


@dataclass(frozen=True)
class Schedule:
    """Rates by step; defaults are those of the paper's fine-tuning."""

    steps: int
    warm_up: int
    """Steps of the linear start."""
    highest: float = 1e-6
    lowest: float = 1e-7
    hold: int = 0
    """Steps at the highest rate before the cosine begins: a run whose length is not known yet holds
    it, and is resumed with the length that there turned out to be time for."""

    def rate(self, step: int) -> float:
        """Learning rate of the optimiser's step number ``step``, counted from 0."""
        if step < self.warm_up:
            return self.highest * (step + 1) / self.warm_up
        begins = self.warm_up + self.hold
        share = (step - begins) / max(self.steps - 1 - begins, 1)
        share = min(max(share, 0.0), 1.0)
        return self.lowest + (self.highest - self.lowest) * 0.5 * (1.0 + math.cos(math.pi * share))


# --------------------------------------------------------------------------------------------------
# Several processes that train one network, each on its share of a step's batches (torchrun).
#
# Gradients are exchanged once a step, after each process has summed up those of its batches: this
# costs the same however many batches a step has.


class TrainingProcess:
    """This process among those that train; alone unless torchrun started it."""

    rank = 0
    count = 1
    device = torch.device("cpu")

    @property
    def leads(self) -> bool:
        """True for the one process that writes files."""
        return self.rank == 0

    def add_up(
        self,
        parameters: Iterable[Tensor],  # [...] each
    ) -> None:
        """Replace every gradient by its sum over the processes."""

    def wait(self) -> None:
        """Wait until every process is here."""


class DistributedProcess(TrainingProcess):
    """A process that torchrun started, once its group is there."""

    def __init__(self) -> None:
        self.rank, self.count = dist.get_rank(), dist.get_world_size()
        if torch.cuda.is_available():
            self.device = torch.device("cuda", int(os.environ["LOCAL_RANK"]))

    def add_up(
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

    def wait(self) -> None:
        """Wait until every process is here."""
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
