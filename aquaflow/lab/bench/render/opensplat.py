"""OpenSplat's CPU kernels compared with ours, through a program that the user brings.

OpenSplat is AGPL: AquaFlow neither holds nor loads any of it. The program is called as
``COMMAND FOLDER``, once for every sample. FOLDER holds ``scene.json`` (``n``, ``width``,
``height``, and ``arrays``: name -> shape) and for each array ``NAME.f32``: float32, little-endian,
row-major. Names, axes and units are those of the renderer contract; ``K`` is the 3 x 3 intrinsic
matrix, ``g_image`` and ``g_alpha`` are the gradients that come in. Colours have three channels,
all that OpenSplat draws. The last line that the program prints is
``{"fwd_ms": number, "bwd_ms": number}``, warm-up and loading not counted.
"""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import tempfile
from pathlib import Path

from aquaflow.base.errors import InputError
from aquaflow.lab.bench.render.timing import Sample
from aquaflow.render.example_scene import NAMES, Size, SplatScene

NOTE = (
    "OpenSplat's CPU depth sort, built against current torch as it is, reads a strided depth "
    "tensor as contiguous and sorts by the wrong key: compare its times, not its pictures. Its "
    "kernel is serial and draws three channels where the others draw four."
)
"""Printed with its numbers."""
LIMIT_S = 600.0
"""A program that takes longer has failed."""
CHANNELS = 3
"""Red, green, blue; the others draw the range too."""


class OpenSplat:
    """A contender whose samples come from the user's program."""

    name = "opensplat"
    isa = "user's build"
    threads = 1
    slow = True

    def __init__(self, command: str) -> None:
        """Raises InputError when there is no such program."""
        self.command = command
        try:
            self.words = shlex.split(command)
        except ValueError as error:
            raise InputError(f"--opensplat {command} is no command: {error}") from error
        if not self.words or shutil.which(self.words[0]) is None:
            raise InputError(
                f"--opensplat {command}: there is no such program; give COMMAND [ARGS]"
            )

    def takes(self, size: Size) -> bool:
        """The user's program is asked for every size."""
        return True

    def sample(self, scene: SplatScene) -> Sample:
        """Raises InputError when the program fails or does not print its times."""
        with tempfile.TemporaryDirectory() as folder:
            write_scene(scene, Path(folder))
            printed = self._run(folder)
        try:
            said = json.loads(printed.strip().splitlines()[-1])
            return Sample(float(said["fwd_ms"]), float(said["bwd_ms"]))
        except (IndexError, KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"--opensplat {self.command}: its last line is not "
                '{"fwd_ms": number, "bwd_ms": number}; print that'
            ) from error

    def _run(self, folder: str) -> str:
        try:
            done = subprocess.run(
                [*self.words, folder],
                capture_output=True,
                text=True,
                errors="replace",
                timeout=LIMIT_S,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise InputError(f"--opensplat {self.command} does not run: {error}") from error
        if done.returncode != 0:
            last = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
            raise InputError(f"--opensplat {self.command} failed ({done.returncode}): {last}")
        return done.stdout


def write_scene(scene: SplatScene, folder: Path) -> None:
    """The files that the program reads."""
    arrays = dict(zip(NAMES, scene.inputs, strict=True))
    arrays |= {"K": scene.K, "g_image": scene.g_image, "g_alpha": scene.g_alpha}
    for name in ("colours", "g_image"):
        arrays[name] = arrays[name][..., :CHANNELS]
    for name, tensor in arrays.items():
        tensor.contiguous().numpy().astype("<f4").tofile(folder / f"{name}.f32")
    size = {"n": scene.size.n, "width": scene.size.width, "height": scene.size.height}
    shapes = {name: list(tensor.shape) for name, tensor in arrays.items()}
    (folder / "scene.json").write_text(json.dumps({**size, "arrays": shapes}) + "\n")
