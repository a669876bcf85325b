"""A picture of how a training goes."""

from __future__ import annotations

from pathlib import Path

NOT_FIGURES = ("step", "cpu_s", "rate")
"""Keys of the history that are not drawn."""


def draw_curve(history: list[dict[str, float]], path: Path) -> None:
    """Training terms on the left, held-out figures on the right, both over CPU time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4), layout="constrained")
    axes = figure.subplots(1, 2)
    minutes = [row["cpu_s"] / 60.0 for row in history]
    for name in history[-1]:
        if name in NOT_FIGURES:
            continue
        values = [row.get(name, float("nan")) for row in history]
        loss = name.startswith("loss_")
        axes[0 if loss else 1].plot(minutes, values, marker=".", label=name.removeprefix("loss_"))
    for axis, title in zip(axes, ("training loss", "held-out pairs"), strict=True):
        axis.set_title(title)
        axis.set_xlabel("CPU minutes")
        axis.grid(alpha=0.3)
        if axis.lines:
            axis.legend(fontsize=8)
    figure.savefig(path, dpi=100)
