"""Compile the C++ kernels while installing; everything else about the package is in pyproject.toml.

`pip install .` puts the libraries into the wheel, `pip install -e .` beside the sources. Without a
compiler the install succeeds and says so.
"""

from __future__ import annotations

import importlib.util
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from types import ModuleType

from setuptools import Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent
NATIVE = Path("aquaflow") / "render" / "native"


def load_module(name: str) -> ModuleType:
    """A module of native/ by its path: the package itself may not be importable yet."""
    spec = importlib.util.spec_from_file_location(f"aquaflow_{name}", ROOT / NATIVE / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


for package in ("drivers", "sim_drivers"):
    if not (ROOT / "aquaflow" / package / "__init__.py").is_file():
        raise SystemExit(
            f"aquaflow/{package} is no link to the folder {package}: this copy of the checkout "
            "lost its symbolic links; copy it with `cp -a`, `rsync -a` or git, or install a wheel"
        )
native = load_module("build")
wheel_platform = load_module("wheel_platform")


def kernel_isas() -> tuple[str, ...]:
    """Variants to build: those of the compiler's target; none without a compiler."""
    compiler = native.find_compiler()
    return () if compiler is None else native.target_isas(compiler)


def build_kernel(isa: str, out_dir: Path) -> str:
    """Compile one variant; what became of it."""
    try:
        return f"aquaflow: built {native.build(isa, out_dir)}"
    except native.BuildError as error:
        return f"aquaflow: no {isa} renderer: {error}"


class BuildWithKernels(build_py):
    """Copies the Python files, then compiles every variant of the compiler's architecture."""

    def run(self) -> None:
        super().run()
        out_dir = ROOT / NATIVE if self.editable_mode else Path(self.build_lib) / NATIVE
        if not self.editable_mode:
            for copied in out_dir.glob("*.so"):
                copied.unlink()  # from the sources' folder: of another day or architecture
        with ThreadPoolExecutor() as pool:  # each waits for a compiler of its own
            for said in pool.map(partial(build_kernel, out_dir=out_dir), kernel_isas()):
                print(said)
        if not list(out_dir.glob("*.so")):
            print("aquaflow: no compiled renderer; the much slower torch renderer will be used")


class PlatformWheel(bdist_wheel):
    """The kernels do not link to Python: one wheel serves every version of it."""

    def get_tag(self) -> tuple[str, str, str]:
        _, _, platform = super().get_tag()
        compiler = native.find_compiler()
        if self.root_is_pure or self.plat_name_supplied or compiler is None:
            return "py3", "none", platform
        build_lib = Path(self.get_finalized_command("build_py").build_lib)
        libraries = sorted((build_lib / NATIVE).glob("*.so"))
        machine = native.target_machine(compiler)
        return "py3", "none", wheel_platform.platform_tag(machine, libraries)


class DistributionWithKernels(Distribution):
    """A platform wheel wherever the kernels can be compiled."""

    def has_ext_modules(self) -> bool:
        return bool(kernel_isas())


setup(
    distclass=DistributionWithKernels,
    cmdclass={"build_py": BuildWithKernels, "bdist_wheel": PlatformWheel},
)
