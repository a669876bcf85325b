"""Buffers of one drawing, and the kernels over them: for the picture, then for its gradient."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from aquaflow.render.contract import tile_grid
from aquaflow.render.webgpu_device import MOMENTS, Device, Step

ROW = 16
"""Numbers of a Gaussian, of its gradient and of its raw parameters."""
MEAN, OPACITY, QUAT = slice(0, 3), slice(3, 4), slice(4, 8)
SCALES, COLOURS = slice(8, 11), slice(12, 16)
"""Where they are in a row; there is a gap behind the scales."""
WORKGROUP = 256
"""Threads of the kernels that take a Gaussian or a hit each."""
SORTED = 2048
"""Keys that a workgroup sorts; BLOCK in sort.wgsl."""
DIGIT_BITS, DIGITS = 4, 16
"""Of a key, in one pass of the sort; as in sort.wgsl."""
DEPTH_BITS = 31
"""Of a positive float."""
ROOM = 1.25
"""What buffers have to spare when they grow: a map grows by a few percent at a time."""
LEAST_HITS = 1 << 14
"""Hits that there is room for to begin with."""


class Drawing:
    """Buffers of one drawing, kept until its gradient was asked for; then of a later one."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.count, self.hits, self.size = -1, LEAST_HITS, (0, 0)
        self._room = 0
        self._fixed: dict[str, Any] = {}
        self._rows: dict[str, Any] = {}
        self._pixels: dict[str, Any] = {}
        self._hits: dict[str, Any] = {}

    # --- buffers ------------------------------------------------------------------------------

    def prepare(self, count: int, width: int, height: int) -> None:
        """Have buffers and a plan for ``count`` Gaussians on a picture of this size."""
        same = (count, (width, height)) == (self.count, self.size)
        new = self.device.buffer
        if not self._fixed:
            self._fixed = {name: new(4) for name in ("total", "listed", "unread")}
            self._fixed["camera"] = new(28, uniform=True)
        if count > self._room or not self._rows:
            self._room = int(ROOM * count)
            names = {"gaussians": ROW, "splats": ROW, "gradients": ROW}
            names |= dict.fromkeys(
                ("keys", "keys_to", "order", "order_to", "hits", "starts", "radius"), 1
            )
            self._rows = {name: new(each * self._room) for name, each in names.items()}
            self._rows["counts"] = new(DIGITS * -(-self._room // SORTED))
            self._rows["blocks"] = new(-(-self._room // WORKGROUP))
            self._rows["view"] = new(12 * -(-self._room // WORKGROUP))
        if (width, height) != self.size:
            rows, columns = tile_grid(width, height)
            sizes = {"colours": 4, "incoming": 4, "rest": 1, "behind": 1}
            self._pixels = {name: new(each * width * height) for name, each in sizes.items()}
            self._pixels["tiles_drawn"] = new(rows * columns)
            self._pixels["ranges"] = new(rows * columns + 1)
        if not self._hits:
            names = {"moments": MOMENTS}
            names |= dict.fromkeys(("tile", "tile_to", "owners", "sorted", "sorted_to"), 1)
            self._hits = {name: new(each * self.hits) for name, each in names.items()}
            self._hits["hit_counts"] = new(DIGITS * -(-self.hits // SORTED))
            same = False
        if not same:
            self.count, self.size = count, (width, height)
            self.drawing_steps, self.gradient_steps = self._plan(), self._plan_backward()

    def make_room(self, hits: int) -> None:
        """Have room for so many hits of tiles."""
        self.hits, self._hits = int(ROOM * hits), {}

    def named(self) -> dict[str, Any]:
        """All buffers by name."""
        return {**self._fixed, **self._rows, **self._pixels, **self._hits}

    # --- the kernels, in their order ----------------------------------------------------------

    def _plan(self) -> list[Step]:
        at, count = self.named(), self.count
        rows, columns = tile_grid(*self.size)
        by_gaussian, by_hit = -(-count // WORKGROUP), -(-self.hits // WORKGROUP)
        plan = [self.step(
            "project", "project", by_gaussian,
            "camera", "gaussians", "tiles_drawn", "splats", "keys", "hits", "radius",
        )]  # fmt: skip
        depths = ("keys", "order", "counts", "listed")
        sorting, order = self._sort(depths, count, DEPTH_BITS)
        plan += sorting
        listing = (order, "splats", "hits", "tiles_drawn", "blocks", "tile", "owners", "starts")
        blocks = self.device.uniform(np.array([by_gaussian, 0, 0, 0], np.uint32))
        plan.append(self.step("hits", "count_hits", by_gaussian, "camera", *listing))
        plan.append(self.step("sum", "sum", 1, blocks, "blocks", "total"))
        plan.append(self.step("hits", "list_hits", by_gaussian, "camera", *listing))
        tiles = ("tile", "sorted", "hit_counts", "total")
        bits = max(1, int(rows * columns - 1).bit_length())
        sorting, hits = self._sort(tiles, self.hits, bits)
        plan += sorting
        tile = "tile_to" if hits == "sorted_to" else "tile"
        plan.append(self.step("ranges", "find_ranges", by_hit, "camera", "total", tile, "ranges"))
        self._hits["in_order"] = at[hits]
        plan.append(self.step(
            "blend", "blend", (columns, rows),
            "camera", "ranges", "in_order", "owners", "splats", "colours", "rest",
        ))  # fmt: skip
        return plan

    def _plan_backward(self) -> list[Step]:
        rows, columns = tile_grid(*self.size)
        return [
            self.step(
                "blend_backward", "blend_backward", (columns, rows),
                "camera", "ranges", "in_order", "owners", "splats", "behind", "incoming", "moments",
            ),
            self.step(
                "project_backward", "project_backward", -(-self.count // WORKGROUP),
                "camera", "gaussians", "splats", "hits", "starts", "moments", "gradients", "view",
            ),
        ]  # fmt: skip

    def _sort(
        self, names: tuple[str, str, str, str], count: int, bits: int
    ) -> tuple[list[Step], str]:
        """Passes over ``count`` keys of ``bits``, and the buffer that their values end in.

        ``names``: of keys, values, the table of counts, and the number of keys.
        """
        key, value, table, total = names
        there, to = (key, value), (f"{key}_to", f"{value}_to")
        blocks, plan = -(-count // SORTED), []
        entries = self.device.uniform(np.array([DIGITS * blocks, 0, 0, 0], np.uint32))
        for shift in range(0, bits, DIGIT_BITS):
            numbers = np.array([shift, blocks, shift == 0, 0], np.uint32)
            turn = self.device.uniform(numbers)
            bound = (turn, total, *there, table, *to)
            plan.append(self.step("sort", "count", blocks, *bound))
            plan.append(self.step("sum", "sum", 1, entries, table, "unread"))
            plan.append(self.step("sort", "move_keys", blocks, *bound))
            there, to = to, there
        return plan, there[1]

    def step(self, file: str, kernel: str, groups: int | tuple[int, int], *bound: Any) -> Step:
        """A kernel on buffers, in the order of its bindings; a name stands for one of ours."""
        named = self.named()
        buffers = [named[each] if isinstance(each, str) else each for each in bound]
        used = _USED.get(kernel, range(len(buffers)))
        pipeline, bindings = self.device.kernel(
            file, kernel, {number: buffers[number] for number in used}
        )
        return Step(pipeline, bindings, groups if isinstance(groups, tuple) else (groups,))

    def look(
        self,
        camera: npt.NDArray[np.uint32],  # [28] bits of the struct Camera
        tiles_drawn: npt.NDArray[np.uint32],  # [rows, columns]
    ) -> None:
        """Let the next drawing of the prepared picture be from this camera."""
        at, write = self.named(), self.device.write
        write(at["camera"], camera)
        write(at["tiles_drawn"], tiles_drawn)
        write(at["listed"], np.array([self.count], np.uint32))

    # --- drawing and differentiating ----------------------------------------------------------

    def draw(
        self,
        gaussians: npt.NDArray[np.float32],  # [N, ROW]
        camera: npt.NDArray[np.uint32],  # [28] bits of the struct Camera
        tiles_drawn: npt.NDArray[np.uint32],  # [rows, columns]
        width: int,
        height: int,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Colours [H, W, 4], transmittance [H, W] and radius [N]."""
        with self.device.lock:
            while True:
                self.prepare(len(gaussians), width, height)
                at, pixels = self.named(), width * height
                self.device.write(at["gaussians"], gaussians)
                self.look(camera, tiles_drawn)
                self.device.submit(self.drawing_steps, clear=[at["ranges"]])
                wanted = {"colours": 4 * pixels, "rest": pixels, "radius": self.count, "total": 1}
                colours, rest, radius, total = self.device.read(
                    [(at[name], count) for name, count in wanted.items()]
                )
                hits = int(total.view(np.uint32)[0])
                if hits <= self.hits:
                    break
                self.make_room(hits)
        drawn = torch.from_numpy(colours).view(height, width, 4)
        return drawn, torch.from_numpy(rest).view(height, width), torch.from_numpy(radius)

    def differentiate(
        self,
        behind: npt.NDArray[np.float32],  # [H, W] dL/d(all that was drawn)
        incoming: npt.NDArray[np.float32],  # [H, W, 4] dL/dcolours
    ) -> tuple[Tensor, Tensor]:
        """Gradients of the Gaussians [N, ROW] and of the view matrix [4, 4]."""
        with self.device.lock:
            at, blocks = self.named(), -(-self.count // WORKGROUP)
            self.device.write(at["behind"], behind)
            self.device.write(at["incoming"], incoming)
            self.device.submit(self.gradient_steps, clear=[at["moments"]])
            gradients, view = self.device.read(
                [(at["gradients"], ROW * self.count), (at["view"], 12 * blocks)]
            )
        viewmat = np.zeros((4, 4), np.float32)
        viewmat[:3] = view.reshape(blocks, 3, 4).sum(0, dtype=np.float64)
        return torch.from_numpy(gradients).view(-1, ROW), torch.from_numpy(viewmat)


_USED = {
    "count": (0, 1, 2, 4),
    "count_hits": (0, 1, 3, 5),
    "compare": (0, 1, 2, 3, 4, 5, 6),
    "differentiate": (0, 1, 2, 3, 4, 5, 7),
}
"""Bindings of kernels that use only some of those that their file declares."""
