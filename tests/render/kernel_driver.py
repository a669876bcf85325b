"""The kernels in a program of their own: for sanitizers, emulators and injected faults."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.render.native import build as native
from tests.render.render_scenes import Scene

SOURCE = Path(__file__).parent / "native" / "kernel_driver.cpp"
TIMEOUT_S = 300.0

Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Task:
    """A scene and all else that the kernels take."""

    scene: Scene
    width: int = 52
    height: int = 39
    threads: int = 2
    active: torch.Tensor | None = None
    seed: int = 7
    arrays: dict[str, Array] = field(init=False)
    """Random image gradients, loss inputs and water."""

    def __post_init__(self) -> None:
        random = np.random.default_rng(self.seed)
        image = (self.height, self.width)
        arrays = {
            "g_image": random.standard_normal((*image, self.scene.colours.shape[1])),
            "g_alpha": random.standard_normal(image),
            "target": random.random((*image, 3)),
            "weight": 2 * random.random(image),
            "mask": (random.random(image) > 0.2).astype(float),
            "water": 0.05 + random.random((5, 3)),
        }
        object.__setattr__(self, "arrays", {k: v.astype(np.float32) for k, v in arrays.items()})

    def with_threads(self, threads: int) -> Task:
        return replace(self, threads=threads)

    def write(self, path: Path) -> None:
        """The file that ``Scene`` of kernel_driver.cpp reads."""
        s = self.scene
        active = torch.zeros(0, dtype=torch.bool) if self.active is None else self.active
        header = [*s.colours.shape, self.width, self.height, self.threads, active.numel()]
        intrinsics = s.K[[0, 1, 0, 1], [0, 1, 2, 2]]
        tensors = (s.means, s.quats, s.scales, s.opacities, s.colours, s.viewmat, intrinsics)
        with path.open("wb") as file:
            np.array(header, np.int32).tofile(file)
            for array in (*(t.numpy() for t in tensors), *self.arrays.values()):
                array.astype(np.float32).tofile(file)
            active.numpy().tofile(file)

    def read(self, path: Path) -> dict[str, torch.Tensor]:
        """What the driver wrote, by name."""
        n, channels = self.scene.colours.shape
        image = (self.height, self.width)
        shapes = {
            **{"image": (*image, channels), "alpha": image, "visible": (n,), "radius_px": (n,)},
            **{"g_means": (n, 3), "g_quats": (n, 4), "g_scales": (n, 3), "g_opacities": (n,)},
            **{"g_colours": (n, channels), "g_viewmat": (4, 4)},
            **{"rendered": (*image, 3), "range": image},
            **{"g_drawn": (*image, 4), "g_water_alpha": image, "g_water": (5, 3)},
            **{"loss": (1,), "g_rendered": (*image, 3), "stepped_means": (n, 3)},
            **{"errors": (2, self.width), "H": (21, 21), "gradient": (21,)},
            **{"gain": (self.width, 21), "offset": (self.width,), "scores": (self.width, 21)},
        }
        values = np.fromfile(path, np.float32)
        ends = np.cumsum([int(np.prod(shape)) for shape in shapes.values()])
        assert ends[-1] == len(values)
        parts = np.split(values, ends[:-1])
        return {
            name: torch.from_numpy(part.copy()).view(shape)
            for (name, shape), part in zip(shapes.items(), parts, strict=True)
        }


def compile_driver(
    compiler: list[str], isa: str, out: Path, flags: tuple[str, ...] = ()
) -> subprocess.CompletedProcess[str]:
    """Build the program ``out`` for one variant; ``flags`` come last and win."""
    command = [*compiler, *native.compile_flags(isa), "-pthread", f"-I{native.NATIVE_DIR}"]
    return subprocess.run(
        [*command, *flags, str(SOURCE), "-o", str(out)],
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )


def run_driver(
    command: list[str], tasks: dict[str, Task], folder: Path, *options: str
) -> dict[str, dict[str, torch.Tensor]]:
    """Results by the tasks' names; fails with what the program said when it stops early."""
    folder.mkdir(parents=True, exist_ok=True)
    files: list[str] = []
    for number, task in enumerate(tasks.values()):
        scene, result = folder / f"{number}.scene", folder / f"{number}.result"
        task.write(scene)
        files += [str(scene), str(result)]
    done = subprocess.run(
        [*command, *options, *files],
        capture_output=True,
        text=True,
        errors="replace",
        timeout=TIMEOUT_S,
        check=False,
    )
    started = [name for name, file in zip(tasks, files[1::2], strict=True) if Path(file).exists()]
    assert done.returncode == 0, f"{done.returncode} in {started[-1:]}: {done.stderr[:4000]}"
    results = {
        name: task.read(Path(result))
        for (name, task), result in zip(tasks.items(), files[1::2], strict=True)
    }
    for file in files:
        Path(file).unlink()
    return results
