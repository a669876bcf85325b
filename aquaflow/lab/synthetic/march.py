"""Where rays meet the height map: steps that cannot miss, then a secant to the exact range.

Every place knows how high the relief reaches within a few radii. A ray that stays above that and
within the radius is free, so it can step there at once, however thin what stands in its way later.
Below that, steps are about a cell. A first pass moves whole bundles of rays through balls that are
empty by the same knowledge.
"""

from __future__ import annotations

import itertools
import math

import cv2
import numpy as np
import torch
from torch.nn import functional

from aquaflow.lab.synthetic.noise import FloatMap
from aquaflow.lab.synthetic.relief import Area

COARSE = 2
"""The highest points are kept on cells this many times larger."""
BALLS_M = (0.02, 0.04, 0.08, 0.16, 0.32, 0.64)
"""Radii within which the highest point is kept."""
FEW = 2
"""How many of them single rays look at: what is farther, their bundle has passed."""
BUNDLE_STEPS = 24
"""Steps of a bundle of rays through empty water."""
COMPACT_EVERY = 4
"""Steps after which rays that have ended are left out."""
LEAST_CELLS = 1.25
"""Smallest step, in cells (about 8 mm): what it could cut off a finger of coral is under 1 mm."""
SECANT_STEPS = 5
"""Illinois steps that refine where a ray meets the surface."""


class RayHeightField:
    """A height map that rays can be shot at. Heights and positions in metres, z up here."""

    def __init__(
        self,
        area: Area,
        height: FloatMap,  # [rows, columns] m
    ) -> None:
        self.top = float(height.max())
        self._cell = area.cell
        self._height = torch.from_numpy(height)[None, None]
        self._crests = torch.from_numpy(_crests(height, area.cell))[None]
        self._few_crests = self._crests[:, :FEW].contiguous()
        rows, columns = area.shape
        self._scale = (2.0 / (columns * area.cell), 2.0 / (rows * area.cell))
        self._shift = (-area.x0 * self._scale[0] - 1.0, -area.y0 * self._scale[1] - 1.0)

    def _sample(
        self,
        maps: torch.Tensor,  # [1, K, rows, columns]
        x: torch.Tensor,  # [N] m
        y: torch.Tensor,  # [N] m
    ) -> torch.Tensor:
        grid = torch.stack(
            [x * self._scale[0] + self._shift[0], y * self._scale[1] + self._shift[1]], dim=-1
        )
        out = functional.grid_sample(
            maps, grid[None, None], padding_mode="border", align_corners=False
        )
        return out[0, :, 0]

    def height(
        self,
        x: torch.Tensor,  # [N] m
        y: torch.Tensor,  # [N] m
    ) -> torch.Tensor:
        """Height [N] at positions x, y [N]."""
        return self._sample(self._height, x, y)[0]

    def normals(
        self,
        x: torch.Tensor,  # [N] m
        y: torch.Tensor,  # [N] m
    ) -> torch.Tensor:
        """[3, N] unit, up, at positions x, y [N]."""
        step = self._cell
        rise_x = self.height(x - step, y) - self.height(x + step, y)
        rise_y = self.height(x, y - step) - self.height(x, y + step)
        up = torch.stack([rise_x, rise_y, torch.full_like(x, 2.0 * step)])
        return functional.normalize(up, dim=0)

    def bundle_start(
        self,
        origin: torch.Tensor,  # [3], or [3, N] of each ray
        rays: torch.Tensor,  # [3, N] unit vectors
        spread: float,  # radius of the bundle over its range
        max_range: float,
    ) -> torch.Tensor:
        """A range [N] before which no ray within ``spread`` of ``rays`` can hit."""
        t = self._above(origin, rays, spread).clamp(0.0, max_range)
        radii = torch.tensor(BALLS_M)[:, None]
        for _ in range(BUNDLE_STEPS):
            x, y, z = (origin[k] + t * rays[k] for k in range(3))
            crest = self._sample(self._crests, x, y)
            # Above everything within a radius: a ball of the lesser of radius and height is empty.
            empty = torch.minimum(z - crest, radii).amax(0)
            # Inside the empty ball the bundle widens, too.
            moving = empty > 1.5 * spread * t
            t = torch.where(moving, (t + 0.9 * (empty - spread * t)).clamp_max(max_range), t)
        return t

    def _above(
        self,
        origin: torch.Tensor,  # [3] m, or [3, N] of each ray
        rays: torch.Tensor,  # [3, N] unit vectors
        spread: float,
    ) -> torch.Tensor:
        """Range [N] at which a ray comes down to the highest point; infinite if it does not."""
        clearance = (origin[2] - self.top).clamp_min(0.0)
        down = -rays[2] + spread
        return torch.where(down > 1e-6, clearance / down.clamp_min(1e-6), torch.inf)

    def hit(
        self,
        origin: torch.Tensor,  # [3], or [3, N] of each ray
        rays: torch.Tensor,  # [3, N] unit vectors
        start: torch.Tensor,  # [N] m, from bundle_start
        pixel: float,  # angle between neighbouring rays
        max_range: float,
    ) -> torch.Tensor:
        """Range [N] in metres; infinite where nothing is hit before ``max_range``."""
        t, last = start.clone(), torch.zeros_like(start)
        live = torch.arange(t.shape[0])
        radii = torch.tensor(BALLS_M[:FEW])[:, None]
        now, stride, at = t, last, origin
        ray = torch.cat([rays, torch.hypot(rays[0], rays[1])[None]])
        # Every step is a step forward, so this ends; a limit would leave rays in open water.
        for step in itertools.count():
            x, y, z = (at[k] + now * ray[k] for k in range(3))
            gap = z - self.height(x, y)
            over = z - self._sample(self._few_crests, x, y)
            # Down to the highest point within the radius, or out to the radius.
            free = torch.minimum(over / (-ray[2]).clamp_min(1e-6), radii / ray[3].clamp_min(1e-6))
            free = torch.where(over > 0.0, free, 0.0).amax(0)
            # A step at least, so that every ray that hits ends just below the surface.
            least = (pixel * now).clamp_min(LEAST_CELLS * self._cell)
            moving = (gap > 0.0) & (now < max_range)
            stride = torch.where(moving, torch.maximum(free, least), stride)
            now = torch.where(moving, now + stride, now)
            if step % COMPACT_EVERY == COMPACT_EVERY - 1:
                t[live], last[live] = now, stride
                keep = moving.nonzero()[:, 0]
                if keep.numel() == 0:
                    break
                live, now, stride, ray = live[keep], now[keep], stride[keep], ray[:, keep]
                at = at if at.dim() == 1 else at[:, keep]
        t = self._refine(origin, rays, t - last, t)
        return torch.where(t < max_range, t, torch.inf)

    def _refine(
        self,
        origin: torch.Tensor,  # [3] m, or [3, N] of each ray
        rays: torch.Tensor,  # [3, N] unit vectors
        above: torch.Tensor,  # [N] m
        below: torch.Tensor,  # [N] m
    ) -> torch.Tensor:
        """The range [N] of the surface between ``above`` and ``below`` it (Illinois secant)."""
        gap_above = self._gap(origin, rays, above).clamp_min(1e-9)
        gap_below = self._gap(origin, rays, below).clamp_max(-1e-9)
        for _ in range(SECANT_STEPS):
            t = above + (below - above) * (gap_above / (gap_above - gap_below))
            gap = self._gap(origin, rays, t)
            over = gap > 0.0
            # An end that stays has its gap halved: neither end can get stuck.
            gap_above = torch.where(over, gap, 0.5 * gap_above)
            gap_below = torch.where(over, 0.5 * gap_below, gap)
            above, below = torch.where(over, t, above), torch.where(over, below, t)
        return above + (below - above) * (gap_above / (gap_above - gap_below).clamp_min(1e-12))

    def _gap(
        self,
        origin: torch.Tensor,  # [3] m, or [3, N] of each ray
        rays: torch.Tensor,  # [3, N] unit vectors
        t: torch.Tensor,  # [N] m
    ) -> torch.Tensor:
        x, y, z = (origin[k] + t * rays[k] for k in range(3))
        return z - self.height(x, y)


def _crests(
    height: FloatMap,  # [rows, columns] m
    cell: float,
) -> FloatMap:
    """Highest point [K, h, w] within each of BALLS_M, on cells COARSE times larger."""
    rows, columns = height.shape
    blocks = height.reshape(rows // COARSE, COARSE, columns // COARSE, COARSE)
    high = np.ascontiguousarray(blocks.max(axis=(1, 3)))
    crests = []
    for radius in BALLS_M:
        # Two cells more: the map is sampled between its cells, and so is the height.
        reach = math.ceil(radius / (cell * COARSE)) + 2
        crests.append(cv2.dilate(high, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)))
    return np.asarray(np.stack(crests), np.float32)
