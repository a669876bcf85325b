"""The Gaussians of one sub-map, each tied to the keyframe that saw it: inserted, moved with it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import KDTree
from torch import Tensor

from aquaflow.config import InsertionConfig
from aquaflow.geometry.similarity import Sim3, Sim3Batch, on_so3, quaternion_from_rotation
from aquaflow.keyframes import Pointmap
from aquaflow.render.contract import COLOUR_SHARPNESS, CPU, radiance
from aquaflow.render.transfers import (
    insertion_in,
    insertion_out,
    moves_in,
    picture_out,
    pointmap_in,
)
from aquaflow.render.views import View

Array: TypeAlias = npt.NDArray[np.floating]

MIN_RADIANCE = 1e-3
"""Darker colours start here: black itself has no finite raw colour."""


class GaussianMap:
    """Parameters as the optimiser sees them, and as the renderer wants them.

    ``means`` [N, 3] world; ``quats`` [N, 4] wxyz, not normalised; ``log_scales`` [N, 3];
    ``opacity_logits`` [N, 1]; ``raw_colours`` [N, 3], softplus of which is the clean radiance J.
    """

    NAMES = ("means", "quats", "log_scales", "opacity_logits", "raw_colours")
    WIDTHS: Mapping[str, int] = {
        "means": 3,
        "quats": 4,
        "log_scales": 3,
        "opacity_logits": 1,
        "raw_colours": 3,
    }

    def __init__(self, local_width: int = 0, device: torch.device = CPU) -> None:
        self.device = device
        self.parameters = {
            name: torch.zeros(0, self.WIDTHS[name], device=device) for name in self.NAMES
        }
        self.keyframes = torch.zeros(0, dtype=torch.int64, device=device)
        """[N] number of the keyframe each Gaussian belongs to."""
        self.local_features = torch.zeros(0, local_width, device=device)
        """[N, F] what a decoder knows of each Gaussian, zero to begin with; F = 0 without one."""

    def __len__(self) -> int:
        return len(self.keyframes)

    @property
    def means(self) -> Tensor:
        """[N, 3] centres, world."""
        return self.parameters["means"]

    @property
    def scales(self) -> Tensor:
        """[N, 3] standard deviations, map units."""
        return torch.exp(self.parameters["log_scales"])

    @property
    def opacities(self) -> Tensor:
        """[N] in (0, 1)."""
        return torch.sigmoid(self.parameters["opacity_logits"][:, 0])

    @property
    def colours(self) -> Tensor:
        """[N, 3] clean radiance J >= 0."""
        return radiance(self.parameters["raw_colours"])

    def extend(
        self,
        new: Mapping[str, Tensor],  # each [M, ...]
        keyframe: int,
    ) -> None:
        """Append Gaussians (tensors by the names above) that ``keyframe`` saw."""
        size = (len(new["means"]),)
        self._grow(new, torch.full(size, keyframe, dtype=torch.int64, device=self.device))

    def append(self, other: GaussianMap) -> None:
        """Append all Gaussians of ``other``, which keep their keyframes but not their features."""
        self._grow(other.parameters, other.keyframes)

    def keep(
        self,
        mask: Tensor,  # [N] bool
    ) -> None:
        """Drop the Gaussians where ``mask`` is False."""
        rows = torch.nonzero(mask)[:, 0]  # once for all tensors
        self._replace(
            {name: self.parameters[name][rows].contiguous() for name in self.NAMES},
            self.keyframes[rows],
            self.local_features[rows].contiguous(),
        )

    def _grow(
        self,
        new: Mapping[str, Tensor],  # each [M, ...]
        keyframes: Tensor,  # [M] int64
    ) -> None:
        features = self.local_features.new_zeros(len(keyframes), self.local_features.shape[1])
        self._replace(
            {n: torch.cat([self.parameters[n], new[n]]).contiguous() for n in self.NAMES},
            torch.cat([self.keyframes, keyframes]),
            torch.cat([self.local_features, features]).contiguous(),
        )

    def _replace(
        self,
        parameters: dict[str, Tensor],  # each [N, ...]
        keyframes: Tensor,  # [N] int64
        features: Tensor,  # [N, F]
    ) -> None:
        """All tables at once, when all are made: a failure leaves them as they were.

        Raises:
            ArithmeticError: a Gaussian is not finite; one alone would spoil every later step.
        """
        finite = [torch.isfinite(tensor).all() for tensor in parameters.values()]
        if not bool(torch.stack(finite).all()):
            raise ArithmeticError("a Gaussian is not finite")
        self.parameters, self.keyframes, self.local_features = parameters, keyframes, features


def raw_colour(
    colour: Tensor,  # [..., 3] >= 0
) -> Tensor:
    """Raw colours whose :func:`~aquaflow.render.contract.radiance` is ``colour``."""
    # softplus_beta^-1(y) = y + log(1 - exp(-beta y)) / beta, with y kept off zero.
    y = colour.clamp_min(MIN_RADIANCE)
    return y + torch.log(-torch.expm1(-COLOUR_SHARPNESS * y)) / COLOUR_SHARPNESS


# --------------------------------------------------------------------------------------------------
# Medium-guided insertion: where new Gaussians go, and how they start (paper, Eq. 16 and 17).

NORMS = {"l1": 1, "l2": 2}
"""Orders of the norms that the config names."""
COVERED_ALPHA = 0.6
"""Alpha from which the map covers a pixel."""
SCALE_OF_SPACING = 0.6
"""Sigma of a new Gaussian over the expected spacing."""
MAX_SPACING_WIDTHS = 0.1
"""Largest expected spacing over image width, where none is asked for."""
CROWDING = 2.0
"""Pixels drawn for each square of the spacing that is asked for: of as many, 0.32 are apart
(Matern's second process), more change little, and later views fill the gaps."""


@dataclass(frozen=True)
class TrackedRange:
    """Range of the scene along every pixel's ray, as tracked."""

    z: Tensor
    """[H, W], in the keyframe's unit; 0 where unknown."""
    known: Tensor
    """[H, W] bool"""
    confidence: Tensor
    """[H, W] in [0, 1]: Q of the paper, saturating at a relative range sigma of 3 %."""

    def keep_in(self, view: View) -> None:
        """Store the range in the view, for its depth loss."""
        view.inverse_range = torch.where(self.known, 1.0 / self.z.clamp_min(1e-6), 0.0)
        view.range_confidence = self.confidence

    def on(self, device: torch.device) -> TrackedRange:
        """The same on the map's device."""
        names = ("z", "known", "confidence")
        return replace(self, **{name: pointmap_in(getattr(self, name), device) for name in names})


def tracked_range(pointmap: Pointmap, known_sigma: float) -> TrackedRange:
    """Known where the relative standard deviation is below ``known_sigma``; on the host."""
    camera, pointmap = pointmap.camera, pointmap.complete(known_sigma)
    known = torch.from_numpy(pointmap.is_known(known_sigma))
    length = torch.from_numpy(camera.unproject(camera.pixel_centres())).norm(dim=-1)
    depth = torch.from_numpy(1.0 / pointmap.rho.clip(1e-6))
    Q = torch.from_numpy(pointmap.Q)
    confidence = (Q / (Q + (1.0 / 0.03) ** 2)).to(torch.float32).sqrt()
    return TrackedRange(
        torch.where(known, length * depth, 0.0).to(torch.float32), known, confidence
    )


def alpha_where_agreed(
    alpha: Tensor,  # [H, W] of the map
    z: Tensor,  # [H, W] range of the map
    tracked_z: Tensor,  # [H, W] range, in the same unit
    config: InsertionConfig,
) -> Tensor:
    """[H, W]: the map's alpha where its surface lies at the tracked range, elsewhere 0.

    Where the map already explains the ray, only missing structure leads to more Gaussians; where
    the map is empty or its surface is at another range, any pixel may.
    """
    agree = (z - tracked_z).abs() < config.agreement * tracked_z
    return torch.where(agree, alpha, 0.0)


def colour_range(
    z: Tensor,  # [H, W] range as tracked, and of the map where nothing was
    shown_z: Tensor,  # [H, W] of the map
    covered: Tensor,  # [H, W] bool: the map has a surface there
    config: InsertionConfig,
) -> Tensor:
    """[H, W] range over which the water is taken out of the picture."""
    return z if config.colour_range == "tracked" else torch.where(covered, shown_z, z)


def structure(
    image: Tensor,  # [H, W, 3]
    config: InsertionConfig,
) -> Tensor:
    """min(|LoG * image|, 1) [H, W]: how much fine structure a pixel belongs to.

    The operator is scale-normalised by sigma^2.
    """
    sigma = config.sigma_px
    response = cv2.Laplacian(cv2.GaussianBlur(picture_out(image), (0, 0), sigma), cv2.CV_32F)
    strength = config.gain * sigma**2 * np.linalg.norm(response, NORMS[config.norm], axis=-1)
    if config.averaged:
        strength = cv2.GaussianBlur(strength, (0, 0), 2.0 * sigma)
    return insertion_in(torch.from_numpy(np.clip(strength, 0.0, 1.0)), image.device)


def insertion_probability(
    restored: Tensor,  # [H, W, 3] J-hat, medium-reduced observation
    rendered: Tensor,  # [H, W, 3] J-tilde, medium-free rendering
    alpha: Tensor,  # [H, W] of the rendering
    config: InsertionConfig,
) -> Tensor:
    """P_a [H, W] of the paper; bare pixels get at least ``bare_probability``.

    Smooth sand has no Laplacian, but it needs a few large Gaussians all the same.
    """
    P = structure(restored, config) - structure(rendered, config)
    bare = torch.where(alpha < COVERED_ALPHA, config.bare_probability, 0.0)
    return torch.maximum(P.clamp_min(0.0), bare)


def density_for(most: float, filled: float) -> float:
    """Gaussians per pixel for each unit of P_a, when the share ``filled`` of the map's cap is used.

    It falls from ``most`` to 1: a small scene gets all the detail that there is room for, and the
    first views of a large one do not leave the others bare.
    """
    return max(min(most, 1.0), most * (1.0 - filled))


def select(
    probability: Tensor,  # [H, W] P_a
    allowed: Tensor,  # [H, W] bool
    density: float,
    config: InsertionConfig,
    generator: torch.Generator,
    spacing_px: Tensor | None = None,  # [H, W]
) -> tuple[Tensor, Tensor]:
    """Rows and columns where P_a is above ``tau_a``: all of them, or drawn with probability
    ``P_a * density``, and of pixels that are to be a spacing apart not many more than can be."""
    above = probability > config.tau_a
    if config.selection == "threshold":
        drawn = above
    else:
        chance = torch.where(above, probability * density, 0.0)
        if spacing_px is not None:
            chance = torch.minimum(chance, CROWDING / spacing_px**2)
        drawn = insertion_in(torch.rand(chance.shape, generator=generator), chance.device) < chance
    rows, columns = torch.nonzero(drawn & allowed, as_tuple=True)
    return rows, columns


def thin(
    rows: Tensor,  # [M]
    columns: Tensor,  # [M]
    room: int,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """At most ``room`` of the pixels, drawn from the whole picture."""
    if len(rows) <= room:
        return rows, columns
    chosen = torch.randperm(len(rows), generator=generator)[: max(room, 0)].sort().values
    chosen = insertion_in(chosen, rows.device)
    return rows[chosen], columns[chosen]


def keep_apart(
    view: View,
    rows: Tensor,  # [M]
    columns: Tensor,  # [M]
    z: Tensor,  # [H, W] range
    spacing_px: Tensor,  # [H, W]
    means: Tensor,  # [N, 3] of the map
    config: InsertionConfig,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """The pixels that are a spacing away from each other and from the map's Gaussians on the same
    surface. Distances are across the line of sight: along it ranges err by more than a spacing."""
    if len(rows) == 0:
        return rows, columns
    at, ranges = insertion_out(torch.stack([rows, columns], dim=-1)), insertion_out(z)
    angles = insertion_out(spacing_px[rows, columns]) / view.camera.fx
    widest = float(angles.max())
    rays = view.camera.unproject(at[:, ::-1] + 0.5)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    margin_px = widest * view.camera.fx
    there = _directions_on(view, ranges, insertion_out(means.detach()), margin_px, config.agreement)
    free = np.ones(len(rays), dtype=bool)
    if len(there):
        free = KDTree(there).query(rays)[0] >= angles
    order = torch.randperm(len(rays), generator=generator).numpy()
    pairs = KDTree(rays).query_pairs(widest, output_type="ndarray")
    near = np.linalg.norm(rays[pairs[:, 0]] - rays[pairs[:, 1]], axis=-1)
    pairs = pairs[(near < angles[pairs].max(axis=1)) & free[pairs].all(axis=1)]
    later = np.where(order[pairs[:, 0]] > order[pairs[:, 1]], pairs[:, 0], pairs[:, 1])
    free[later] = False
    chosen = insertion_in(torch.from_numpy(free), rows.device)
    return rows[chosen], columns[chosen]


def _directions_on(
    view: View,
    ranges: Array,  # [H, W]; 0 where unknown
    means: Array,  # [N, 3] world
    margin_px: float,
    agreement: float,
) -> Array:
    """[K, 3] unit vectors to the points that lie on the surface that ``view`` sees, or less than
    a margin beside its picture, at the ranges there up to a share of ``agreement``."""
    points = (means - view.T_wc.t) @ view.T_wc.R
    points = points[points[:, 2] > 0.0]
    at = np.floor(view.camera.project(points))[:, ::-1]
    last = np.array(ranges.shape) - 1.0
    inside = ((at >= -margin_px) & (at <= last + margin_px)).all(axis=-1)
    points, at = points[inside], np.clip(at[inside], 0.0, last).astype(np.intp)
    lengths, seen = np.linalg.norm(points, axis=-1), ranges[at[:, 0], at[:, 1]]
    agree = np.abs(lengths - seen) < agreement * seen
    return np.asarray(points[agree] / lengths[agree, None])


def worth_keeping(gaussians: GaussianMap, count: int) -> Tensor:
    """[N] bool: the ``count`` Gaussians without which most of the pictures would be missing.

    That is opacity times cross-section, of the two longer axes and in units of the map.
    """
    scales = gaussians.scales
    worth = gaussians.opacities * scales.prod(dim=-1) / scales.amin(dim=-1)
    keep = torch.ones(len(worth), dtype=torch.bool, device=worth.device)
    keep[torch.argsort(worth, stable=True)[: len(worth) - count]] = False
    return keep


def new_gaussians(
    view: View,
    rows: Tensor,  # [M]
    columns: Tensor,  # [M]
    z: Tensor,  # [H, W] range
    colour: Tensor,  # [H, W, 3] J-hat
    confidence: Tensor,  # [H, W] in [0, 1]
    probability: Tensor,  # [H, W] P_a
    density: float,
    config: InsertionConfig,
    spacing_px: Tensor | None = None,  # [H, W]
) -> dict[str, Tensor]:
    """Start values: on the pixel's ray, as wide as the expected spacing, coloured by J-hat.

    Pixels for which one of them is not finite get no Gaussian.
    """
    pixels = insertion_out(torch.stack([columns, rows], dim=-1)) + 0.5
    rays = view.camera.unproject(pixels)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    distance = insertion_out(z[rows, columns]).astype(np.float64)
    means = (rays * distance[:, None]) @ view.T_wc.R.T + view.T_wc.t
    # Expected distance to the nearest neighbour when a share p of the pixels is drawn: 1 / sqrt(p).
    share = (probability[rows, columns] * density).clamp(1e-4, 1.0)
    if config.selection == "threshold":
        share = torch.ones_like(share)  # neighbours are a pixel apart
    spacing = share.rsqrt().clamp(1.0, MAX_SPACING_WIDTHS * view.camera.width)
    if spacing_px is not None:
        spacing = torch.maximum(spacing, spacing_px[rows, columns])
    scale = SCALE_OF_SPACING * spacing * z[rows, columns] / view.camera.fx
    opacity = (config.opacity * confidence[rows, columns]).clamp(0.05, 0.95)
    quats = torch.zeros(len(rows), 4, device=rows.device)
    quats[:, 0] = 1.0
    new = {
        "means": insertion_in(torch.from_numpy(means).to(torch.float32), rows.device),
        "quats": quats,
        "log_scales": torch.log(scale)[:, None].repeat(1, 3),
        "opacity_logits": torch.logit(opacity)[:, None],
        "raw_colours": raw_colour(colour[rows, columns]),
    }
    sound = torch.stack([torch.isfinite(values).all(dim=-1) for values in new.values()]).all(0)
    return new if bool(sound.all()) else {name: values[sound] for name, values in new.items()}


# --------------------------------------------------------------------------------------------------
# The map follows its keyframes: Gaussians and views move by the full similarity.


@torch.no_grad()
def move_gaussians(gaussians: GaussianMap, moves: Mapping[int, Sim3]) -> torch.Tensor:
    """Move what belongs to the keyframes in ``moves``, place, orientation and size, in place.

    ``moves`` holds for a keyframe's number the similarity that maps its old world to its new one.
    Returns the rows [M] that were moved; the cost grows with M.

    Raises:
        ArithmeticError: where they go is not finite; nothing has moved then.
    """
    if not moves or len(gaussians) == 0:
        return torch.zeros(0, dtype=torch.int64, device=gaussians.device)
    # All at once: one by one, the quaternions of 2000 keyframes would take 60 ms.
    S = Sim3Batch.of([moves[number] for number in sorted(moves)])
    numbers, *tables = (
        moves_in(torch.from_numpy(column), gaussians.device)
        for column in (np.array(sorted(moves)), S.R, S.t, quaternion_from_rotation(S.R), S.scale)
    )
    rows = torch.nonzero(torch.isin(gaussians.keyframes, numbers))[:, 0]
    which = torch.searchsorted(numbers, gaussians.keyframes[rows])
    R, t, turn, scale = (table[which] for table in tables)
    scale = scale[:, None]
    means, quats = (gaussians.parameters[name] for name in ("means", "quats"))
    turned = torch.einsum("nij,nj->ni", R, means[rows].double())
    moved = (scale * turned + t).float()
    facing = quaternion_product(turn, quats[rows].double()).float()
    growth = torch.log(scale).float()
    if not all(bool(torch.isfinite(each).all()) for each in (moved, facing, growth)):
        raise ArithmeticError("a correction of the map is not finite")
    means[rows], quats[rows] = moved, facing
    gaussians.parameters["log_scales"][rows] += growth
    return rows


def move_views(views: Iterable[View], moves: Mapping[int, Sim3]) -> None:
    """Re-anchor the views of the keyframes in ``moves``.

    Raises:
        ArithmeticError: where they go is not finite; no view has moved then.
    """
    moving = [view for view in views if view.keyframe in moves]
    if not moving:
        return
    # All at once: one by one, the 2000 views of two joined lines would take half a second.
    before = Sim3Batch.of([view.T_wc for view in moving])
    moved = Sim3Batch.of([moves[view.keyframe] for view in moving]) @ before
    moved = replace(moved, R=on_so3(moved.R)).if_finite()
    for i, view in enumerate(moving):
        view.T_wc = moved.element(i)


def quaternion_product(
    a: torch.Tensor,  # [N, 4] wxyz
    b: torch.Tensor,  # [N, 4] wxyz
) -> torch.Tensor:
    """[N, 4]: the rotation b, then the rotation a."""
    aw, av, bw, bv = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    w = aw * bw - (av * bv).sum(1, keepdim=True)
    return torch.cat([w, aw * bv + bw * av + torch.linalg.cross(av, bv)], dim=1)
