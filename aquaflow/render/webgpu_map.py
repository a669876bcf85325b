"""A map on the GPU: its optimiser's steps, without its numbers coming back to the host.

Up go the view's picture and camera, down come the loss, and the gradients of the water and of the
view matrix. The map itself goes up when it has changed on the host, and comes down when the host
asks for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from aquaflow.render.adam import SelectiveAdam
from aquaflow.render.contract import tile_grid
from aquaflow.render.webgpu_device import Device, Step
from aquaflow.render.webgpu_drawing import (
    COLOURS,
    MEAN,
    OPACITY,
    QUAT,
    ROOM,
    ROW,
    SCALES,
    WORKGROUP,
    Drawing,
)

COLUMNS = {
    "means": MEAN,
    "opacity_logits": OPACITY,
    "quats": QUAT,
    "log_scales": SCALES,
    "raw_colours": slice(COLOURS.start, COLOURS.stop - 1),  # the range follows from the mean
}
"""Of a row of raw parameters, by the names of a GaussianMap."""
COUNT_AT = SCALES.stop
"""Of a row of first moments: the count of steps, in the gap behind the scales."""
LOSSES, VOLUMES, WATER, VIEW, RESULTS = 0, 1, 2, 7, 10
"""Places of what a step comes to among the vectors that are read, and their number."""


@dataclass(frozen=True)
class Weights:
    """Of the loss, and which of its terms a view has."""

    ssim: float
    ranges: float
    volumes: float
    tau_e: float
    """Residual beyond which a pixel of a common frame is an outlier."""


@dataclass(frozen=True)
class Observed:
    """A view as a step needs it, on the host."""

    viewmat: Tensor  # [4, 4] world -> camera
    camera: npt.NDArray[np.uint32]  # [28] bits of the struct Camera
    size: tuple[int, int]  # width and height, px
    tiles_drawn: npt.NDArray[np.uint32]  # [rows, columns]
    pixels: npt.NDArray[np.uint32]  # [H, W, 3] colours and mask, bits of 1 / range and confidence
    has_ranges: bool
    inverse_scale: float
    """What 1 / range is multiplied by to be the map's."""
    robust: bool
    water: Tensor | None  # [5, 3] beta, B_inf, b, B_res, d


@dataclass(frozen=True)
class Outcome:
    """What a step came to."""

    loss: float
    """Where it is not finite, nothing was moved."""
    g_water: Tensor
    """[5, 3]"""
    g_viewmat: Tensor
    """[4, 4]"""
    errors: Tensor | None
    """[rows, columns] mean error of each tile, of full scale, where it was asked for."""


class MapOnGpu:
    """Parameters and moments of a map's Gaussians on the GPU, and the kernels of a step."""

    def __init__(self, device: Device, weights: Weights) -> None:
        self.device, self.weights = device, weights
        self.is_loaded = False
        self.drawing = Drawing(device)
        self._rows: dict[str, Any] = {}
        self._pixels: dict[str, Any] = {}
        self._small: dict[str, Any] = {}
        self._planned: tuple[int, int, tuple[int, int], int] | None = None
        """Gaussians, room for them, picture and room for hits that the kernels are bound for."""
        self._size = (0, 0)
        self._count = 0

    # --- the map, up and down -----------------------------------------------------------------

    def load(
        self,
        parameters: Mapping[str, Tensor],  # each [N, ...], of a GaussianMap
        adam: SelectiveAdam,
    ) -> None:
        """Bring the map up, as it is on the host."""
        self._count = len(parameters["means"])
        with self.device.lock:
            if not self._rows or self._count > self._rows["room"]:
                room = int(ROOM * self._count)
                names = ("raw", "first", "second")
                self._rows = {name: self.device.buffer(ROW * room) for name in names}
                self._rows["room"] = room
            tables = {
                "raw": parameters,
                "first": adam.first_moments,
                "second": adam.second_moments,
            }
            for name, table in tables.items():
                rows = np.zeros((self._count, ROW), np.float32)
                for column, where in COLUMNS.items():
                    rows[:, where] = table[column].detach().numpy()
                if name == "first":
                    rows[:, COUNT_AT] = adam.steps.numpy()
                self.device.write(self._rows[name], rows)
            if "bias" not in self._small:
                self._small["bias"] = self.device.buffer(adam.bias.numel())
                self.device.write(self._small["bias"], adam.bias.numpy())
                self._small["results"] = self.device.buffer(4 * RESULTS)
                self._small["rates"] = self.device.buffer(12, uniform=True)
                self._small["step"] = self.device.buffer(36, uniform=True)
        self._bias_rows = len(adam.bias)
        self._settings = (1.0 - adam.betas[0], 1.0 - adam.betas[1], adam.eps)
        self.is_loaded = True

    def save(
        self,
        parameters: Mapping[str, Tensor],  # each [N, ...], of a GaussianMap
        adam: SelectiveAdam,
    ) -> None:
        """Bring the map down into the same tensors that were loaded."""
        names = ("raw", "first", "second")
        with self.device.lock:
            found = self.device.read([(self._rows[name], ROW * self._count) for name in names])
        rows = [torch.from_numpy(each).view(-1, ROW) for each in found]
        tables = (parameters, adam.first_moments, adam.second_moments)
        for table, each in zip(tables, rows, strict=True):
            for column, where in COLUMNS.items():
                table[column].detach().copy_(each[:, where].view(table[column].shape))
        adam.steps.copy_(rows[1][:, COUNT_AT])

    # --- one step -----------------------------------------------------------------------------

    def draw(
        self,
        view: Observed,
        gains: npt.NDArray[np.float32] | None,  # [H, W, 4] of the light in RGB, of the backscatter
    ) -> None:
        """Draw the view, through the water; None: all gains are one."""
        with self.device.lock:
            self._prepare(view)
            self._write(view)
            self._write_gains(gains)
            at = self.drawing.named()
            self.device.submit(self._drawn, clear=[at["ranges"], at["total"]])

    def picture(self) -> tuple[Tensor, Tensor]:
        """The drawn picture [H, W, 3] and its alpha [H, W]."""
        with self.device.lock:
            width, height = self.drawing.size
            pixels = width * height
            parts = [(self._pixels["image"], 4 * pixels), (self.drawing.named()["rest"], pixels)]
            image, rest = self.device.read(parts)
        drawn = torch.from_numpy(image).view(height, width, 4)
        return drawn[..., :3], 1.0 - torch.from_numpy(rest).view(height, width)

    def relight(
        self,
        gains: npt.NDArray[np.float32] | None,  # [H, W, 4]
    ) -> None:
        """Let the drawn view have other gains."""
        with self.device.lock:
            self._write_gains(gains)
            self.device.submit(self._drawn[-1:])

    def radius_px(self) -> Tensor:
        """[N] of the drawn view, as a renderer says it."""
        with self.device.lock:
            (found,) = self.device.read([(self.drawing.named()["radius"], self._count)])
        return torch.from_numpy(found)

    def finish(self, adam: SelectiveAdam, errors: bool) -> Outcome | None:
        """Compare with the picture, differentiate, and move the Gaussians that were visible.

        ``errors``: whether those of tiles are asked for. None where there was too little room for
        the drawing: draw again.
        """
        with self.device.lock:
            self._write_rates(adam.learning_rates)
            at = self.drawing.named()
            self.device.submit(self._compared, clear=[at["moments"]])
            rows, columns = tile_grid(*self.drawing.size)
            wanted = [(self._small["results"], 4 * RESULTS), (at["total"], 2)]
            tiles = [(self._pixels["losses"], 4 * rows * columns)] if errors else []
            results, total, *losses = self.device.read([*wanted, *tiles])
            hits, left_out = (int(n) for n in total.view(np.uint32))
            if hits > self.drawing.hits:
                self.drawing.make_room(hits)
                return None
        adam.count_skipped(left_out)
        of_tiles = torch.from_numpy(losses[0]).view(rows, columns, 4)[..., 3] if errors else None
        found = results.reshape(RESULTS, 4).astype(np.float64)
        g_viewmat = np.zeros((4, 4), np.float32)
        g_viewmat[:3] = found[VIEW : VIEW + 3]
        return Outcome(
            self._loss(found),
            torch.from_numpy(found[WATER : WATER + 5, :3].astype(np.float32)),
            torch.from_numpy(g_viewmat),
            of_tiles,
        )

    def _loss(
        self,
        found: npt.NDArray[np.float64],  # [RESULTS, 4]
    ) -> float:
        pixels, weights = self.drawing.size[0] * self.drawing.size[1], self.weights
        l1, unlike, ranges, _ = found[LOSSES]
        pictures = (1.0 - weights.ssim) * l1 + weights.ssim * unlike
        volumes = weights.volumes * found[VOLUMES, 0] / max(self._count, 1)
        return float(pictures / (3 * pixels) + weights.ranges * ranges / pixels + volumes)

    # --- buffers ------------------------------------------------------------------------------

    def _prepare(self, view: Observed) -> None:
        width, height = view.size
        self.drawing.prepare(self._count, width, height)
        wanted = (self._count, self._rows["room"], view.size, self.drawing.hits)
        if wanted == self._planned:
            return
        new = self.device.buffer
        if view.size != self._size:
            rows, columns = tile_grid(width, height)
            sizes = {"image": 4, "mask": 1, "slopes": 12, "g_image": 4, "gains": 4, "observed": 3}
            self._pixels = {name: new(each * width * height) for name, each in sizes.items()}
            self._pixels["losses"] = new(4 * rows * columns)
            self._pixels["waters"] = new(20 * rows * columns)
            self._size, self._even = view.size, False
        self._small["volumes"] = new(4 * -(-self._count // WORKGROUP))
        self._drawn, self._compared = self._plan()
        self._planned = wanted

    def _write(self, view: Observed) -> None:
        write = self.device.write
        width, height = view.size
        _, columns = tile_grid(width, height)
        weights = self.weights
        R, t = view.viewmat[:3, :3].numpy(), view.viewmat[:3, 3].numpy()
        whole = [
            *(width, height, columns, self._count),
            *(view.robust, view.has_ranges, view.water is not None, 0),
        ]
        water = np.zeros((5, 4), np.float32)
        if view.water is not None:
            water[:, :3] = view.water.detach().numpy()
        ranges = weights.ranges if view.has_ranges else 0.0
        numbers = [weights.ssim, ranges, weights.volumes, weights.tau_e]
        floats = np.array([*numbers, *(-R.T @ t), view.inverse_scale, *water.ravel()], np.float32)
        bits = np.concatenate([np.array(whole, np.uint32), floats.view(np.uint32)])
        write(self._small["step"], bits)
        self.drawing.look(view.camera, view.tiles_drawn)
        write(self._pixels["observed"], view.pixels)

    def _write_gains(
        self,
        gains: npt.NDArray[np.float32] | None,  # [H, W, 4]
    ) -> None:
        if gains is not None:
            self.device.write(self._pixels["gains"], gains)
        elif not self._even:
            width, height = self.drawing.size
            self.device.write(self._pixels["gains"], np.ones((height, width, 4), np.float32))
        self._even = gains is None

    def _write_rates(self, rates: Mapping[str, float]) -> None:
        names = ("means", "quats", "log_scales", "raw_colours", "opacity_logits")
        floats = np.array([*(rates[name] for name in names), *self._settings], np.float32)
        counts = np.array([self._bias_rows, self.drawing.hits, 0, 0], np.uint32)
        self.device.write(self._small["rates"], np.concatenate([floats.view(np.uint32), counts]))

    # --- the kernels, in their order ----------------------------------------------------------

    def _plan(self) -> tuple[list[Step], list[Step]]:
        """What draws, and what compares, differentiates and moves."""
        at, pixels, small, rows = self.drawing.named(), self._pixels, self._small, self._rows
        tile_rows, columns = tile_grid(*self.drawing.size)
        tiles, blocks = (columns, tile_rows), -(-self._count // WORKGROUP)
        step, results = small["step"], small["results"]
        do, sum_up = self.drawing.step, self._sum
        light = ("colours", "rest", pixels["gains"])
        seen = (pixels["image"], pixels["mask"], pixels["observed"], "rest", pixels["slopes"])
        compared = (step, *seen, pixels["losses"], pixels["g_image"])
        backward = (step, *light, pixels["g_image"], "incoming", "behind", pixels["waters"])
        drawn = [
            do("activate", "activate", blocks, step, rows["raw"], "gaussians", small["volumes"]),
            *self.drawing.drawing_steps,
            do("compose", "compose", tiles, step, *light, pixels["observed"], "tiles_drawn",
               pixels["image"], pixels["mask"]),
        ]  # fmt: skip
        moved = [
            do("loss", "compare", tiles, *compared),
            sum_up(pixels["losses"], tile_rows * columns, 1, LOSSES),
            sum_up(small["volumes"], blocks, 1, VOLUMES),
            do("loss", "differentiate", tiles, *compared),
            do("compose_backward", "compose_backward", tiles, *backward),
            sum_up(pixels["waters"], tile_rows * columns, 5, WATER),
            *self.drawing.gradient_steps,
            sum_up(at["view"], blocks, 3, VIEW),
            do("adam", "adam", blocks, step, small["rates"], rows["raw"], rows["first"],
               rows["second"], "gradients", "radius", small["bias"], results, "total"),
        ]  # fmt: skip
        return drawn, moved

    def _sum(self, table: Any, rows: int, columns: int, place: int) -> Step:
        shape = self.device.uniform(np.array([rows, columns, place, 0], np.uint32))
        return self.drawing.step("reduce", "reduce", columns, shape, table, self._small["results"])
