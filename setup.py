"""Compile the C++ kernels while installing; everything else about the package is in pyproject.toml.

`pip install .` puts the libraries into the wheel, `pip install -e .` beside the sources. Without a
compiler the install succeeds and says so.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

from setuptools import Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent
NATIVE = Path("aquaflow") / "render" / "native"


def load_build_module() -> ModuleType:
    """native/build.py by its path: the package itself may not be importable yet."""
    spec = importlib.util.spec_from_file_location("aquaflow_build", ROOT / NATIVE / "build.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


native = load_build_module()


class BuildWithKernels(build_py):
    """Copies the Python files, then compiles every variant of this architecture."""

    def run(self) -> None:
        super().run()
        out_dir = ROOT / NATIVE if self.editable_mode else Path(self.build_lib) / NATIVE
        for isa in native.buildable_isas():
            try:
                print(f"aquaflow: built {native.build(isa, out_dir)}")
            except native.BuildError as error:
                print(f"aquaflow: no {isa} renderer: {error}; the slower torch renderer is used")


class PlatformWheel(bdist_wheel):
    """The kernels do not link to Python: one wheel serves every version of it."""

    def get_tag(self) -> tuple[str, str, str]:
        _, _, platform = super().get_tag()
        return "py3", "none", platform


class DistributionWithKernels(Distribution):
    """A platform wheel wherever the kernels can be compiled."""

    def has_ext_modules(self) -> bool:
        return native.find_compiler() is not None and bool(native.buildable_isas())


setup(
    distclass=DistributionWithKernels,
    cmdclass={"build_py": BuildWithKernels, "bdist_wheel": PlatformWheel},
)
