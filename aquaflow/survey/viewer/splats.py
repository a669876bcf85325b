"""Gaussians as a browser gets them: those that matter most, those that cover most first."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float32]
Levels = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class ViewerSplats:
    """N Gaussians in the world; those whose opacity and area are largest come first, and those that
    float before them."""

    centres: Float
    """[N, 3]"""
    wxyz: Float
    """[N, 4] unit rotations."""
    scales: Float
    """[N, 3] standard deviations along their axes."""
    opacities: Float
    """[N]"""
    colours: Float
    """[N, 3] without the water, at least 0."""
    levels: dict[str, Levels] = field(default_factory=dict)
    """[N] further values of each, by name: 0 to 255, as a palette has colours for them."""
    floaters: int = 0
    """How many float, see :mod:`aquaflow.survey.viewer.floaters`: the first ones."""

    def __len__(self) -> int:
        return len(self.centres)

    def among(
        self,
        chosen: npt.NDArray[np.bool_] | slice,  # [N]
    ) -> ViewerSplats:
        """Only those, none of which counts as floating."""
        return ViewerSplats(
            self.centres[chosen], self.wxyz[chosen], self.scales[chosen], self.opacities[chosen],
            self.colours[chosen], {name: values[chosen] for name, values in self.levels.items()},
        )  # fmt: skip

    def weights(self) -> Float:
        """[N] opacity times area of the two largest axes: what each covers."""
        return weights(self.opacities, self.scales)


def splats(
    means: Float,  # [N, 3]
    quats: Float,  # [N, 4] wxyz, of any length
    scales: Float,  # [N, 3]
    opacities: Float,  # [N]
    colours: Float,  # [N, 3]
    budget: int,
    levels: dict[str, Levels] | None = None,  # [N] each
    floaters: npt.NDArray[np.bool_] | None = None,  # [N]
) -> ViewerSplats:
    """At most ``budget`` of them: those that cover most, by opacity and area. The others' share of
    the surface goes to them, so that no holes open; ``floaters`` are none.

    What is not finite is left out.
    """
    sound = np.isfinite(means).all(1) & np.isfinite(scales).all(1) & np.isfinite(quats).all(1)
    sound &= np.isfinite(opacities) & np.isfinite(colours).all(1)
    weight = weights(np.where(sound, opacities, 0.0), np.where(sound[:, None], scales, 0.0))
    floats = np.zeros(len(means), bool) if floaters is None else floaters
    order = np.lexsort((-weight, ~floats))
    chosen = order[sound[order]][:budget]
    surface = ~floats[chosen]
    share = float(weight[chosen[surface]].sum() / max(float(weight[~floats].sum()), 1e-12))
    grown = 1.0 if surface.sum() == (sound & ~floats).sum() else growth(share)
    own = {name: values[chosen] for name, values in (levels or {}).items()}
    return viewer_splats(
        means[chosen], quats[chosen], grown * scales[chosen], opacities[chosen], colours[chosen],
        own, int((~surface).sum()),
    )  # fmt: skip


def growth(share: float) -> float:
    """Factor by which those grow that cover this share of the surface: areas by the root of what
    was left out: twice the gaps, no mud."""
    return float(min(max(share, 0.25), 1.0) ** -0.25)


def viewer_splats(
    means: Float,  # [N, 3]
    quats: Float,  # [N, 4] wxyz, of any length
    scales: Float,  # [N, 3]
    opacities: Float,  # [N]
    colours: Float,  # [N, 3]
    levels: dict[str, Levels],  # [N] each
    floaters: int = 0,
) -> ViewerSplats:
    """Finite Gaussians in their order, the first of which float."""
    return ViewerSplats(
        means.astype(np.float32),
        _unit(quats),
        scales.astype(np.float32),
        np.clip(opacities, 0.0, 1.0).astype(np.float32),
        np.maximum(colours, 0.0).astype(np.float32),
        levels,
        floaters,
    )


def weights(
    opacities: Float,  # [N]
    scales: Float,  # [N, 3]
) -> Float:
    """[N] opacity times area of the two largest axes."""
    return np.asarray(opacities * np.sort(scales, axis=1)[:, 1:].prod(axis=1), np.float32)


def covariances(
    quats: Float,  # [N, 4] wxyz, of any length
    scales: Float,  # [N, 3]
) -> Float:
    """[N, 3, 3] R S S^T R^T."""
    w, x, y, z = _unit(quats).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    R = np.moveaxis(np.array(rows), -1, 0)
    M = R * scales[:, None, :]
    return np.asarray(M @ M.transpose(0, 2, 1), dtype=np.float32)


def _unit(
    quats: Float,  # [N, 4]
) -> Float:
    length = np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)
    return np.asarray(quats / length, np.float32)
