"""The Pareto front: the runs that no other run improves in both time and error."""

from __future__ import annotations

from collections.abc import Sequence


def pareto_front(cost: Sequence[float], error: Sequence[float]) -> list[int]:
    """Indices of the points with no other as cheap and as good, and better in one; by cost."""
    order = sorted(range(len(cost)), key=lambda i: (cost[i], error[i]))
    front: list[int] = []
    for i in order:
        if not front or error[i] < error[front[-1]]:
            front.append(i)
    return front
