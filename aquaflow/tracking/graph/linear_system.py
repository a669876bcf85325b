"""The sparse linear system of a pose graph: 7 x 7 blocks, factored by SuperLU (scipy)."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from aquaflow.tracking.graph.equations import Array, Equations, Index, Mask, Rows, damping_of

MEMORY = 10
"""Number of past steps in the BFGS update."""


class LinearSystem:
    """Solves for the steps of the active poses; keeps its factor until :meth:`factor` is called.

    Steps after a factor's first are corrected by limited-memory BFGS (Nocedal, 1980), with the
    factor as the first guess of the Hessian: Gauss-Newton leaves out what bends the long soft
    modes of a graph, and alone takes dozens of factors to settle them.
    """

    def __init__(
        self,
        edges: Rows,  # [m]
        active: Mask,  # [n]
    ) -> None:
        self._active = active
        self._factor: SuperLU | None = None
        self._memory: list[tuple[Array, Array]] = []
        self._last: tuple[Array, Array] | None = None
        place = np.full(len(active), -1, dtype=np.intp)
        place[active] = np.arange(active.sum())
        a, b = place[edges["a"]], place[edges["b"]]
        self._both = (a >= 0) & (b >= 0)
        order = _ordering(a[self._both], b[self._both], int(active.sum()))
        self._a, self._b, self._own = order[a[self._both]], order[b[self._both]], order

    def factor(self, at: Equations, damping: float) -> None:
        """Factor the equations, damped by a share of their diagonal."""
        self._memory, self._last = [], None
        diagonal, links = at.diagonal[self._active], at.H_ab[self._both]
        own = diagonal + damping_of(diagonal, damping)[:, :, None] * np.eye(7)
        blocks = np.concatenate([own, links, links.transpose(0, 2, 1)])
        rows = np.concatenate([self._own, self._a, self._b])
        columns = np.concatenate([self._own, self._b, self._a])
        try:
            self._factor = splu(
                _assemble(blocks, rows, columns, len(self._own)),
                permc_spec="NATURAL",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError:
            self._factor = None

    def step(self, at: Equations) -> Array | None:
        """[n, 7] step of all poses, zero for those that stay; None if the system is singular."""
        if self._factor is None:
            return None
        gradient = np.empty((len(self._own), 7))
        gradient[self._own] = at.gradient[self._active]
        solution = self._correct(self._factor, gradient.ravel())
        step = np.zeros((len(self._active), 7))
        step[self._active] = solution.reshape(-1, 7)[self._own]
        return step if np.isfinite(step).all() else None

    def note_step(self, share: float) -> None:
        """Record that the last step was taken, at a share of its length."""
        if self._last is not None:
            self._last = (share * self._last[0], self._last[1])

    def _correct(
        self,
        factor: SuperLU,
        gradient: Array,  # [n]
    ) -> Array:
        """The two-loop recursion of BFGS around the factor."""
        if self._last is not None:
            taken, before = self._last
            change = gradient - before
            if taken @ change > 0.0:
                self._memory = [*self._memory[1 - MEMORY :], (taken, change)]
        q, shares = gradient.copy(), []
        for taken, change in reversed(self._memory):
            shares.append(float(taken @ q) / float(taken @ change))
            q -= shares[-1] * change
        step = np.asarray(factor.solve(q))
        for taken, change in self._memory:
            step += (shares.pop() - float(change @ step) / float(taken @ change)) * taken
        self._last = (-step, gradient)
        return -step


def _ordering(
    a: Index,  # [m]
    b: Index,  # [m]
    count: int,
) -> Index:
    """[count] place of each block: minimum degree on the graph of blocks, so it costs little."""
    links = sparse.coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count))
    graph = links + links.T
    dominant = sparse.diags(np.asarray(abs(graph).sum(axis=0)).ravel() + 1.0)
    factor = splu(
        sparse.csc_matrix(graph + dominant),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    return np.asarray(factor.perm_c, dtype=np.intp)


def _assemble(
    blocks: Array,  # [B, 7, 7]
    rows: Index,  # [B] of blocks
    columns: Index,  # [B] of blocks
    count: int,
) -> sparse.csc_matrix:
    """Block-sparse symmetric matrix [7 count, 7 count]."""
    order = np.argsort(rows * count + columns, kind="stable")
    starts = np.searchsorted(rows[order], np.arange(count + 1))
    shape = (7 * count, 7 * count)
    matrix = sparse.bsr_matrix((blocks[order], columns[order], starts), shape=shape).tocsr()
    matrix.sum_duplicates()
    # Rows of a symmetric matrix are its columns: read as compressed columns, it is the same.
    return sparse.csc_matrix((matrix.data, matrix.indices, matrix.indptr), shape=shape)
