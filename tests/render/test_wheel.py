"""The wheel: one for every Python version, with the kernels in it, installed without a compiler."""

from __future__ import annotations

import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from aquaflow.render.native import build as native

ROOT = Path(__file__).resolve().parents[2]
PARTS = ("pyproject.toml", "setup.py", "README.md", "LICENSE", "aquaflow", "drivers", "sim_drivers")
PAGE = {".html", ".css", ".js", ".svg"}
CROSS_COMPILER = "aarch64-linux-gnu-g++"
NO_COMPILER = {"PATH": "/nonexistent", "CXX": "/nonexistent/g++"}

SHOW_RENDERER = """
import warnings
from aquaflow.render import select_renderer
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    renderer = select_renderer("auto")
print(renderer.name, len(caught))
if renderer.name == "cpu":
    from aquaflow.render.library import load_library
    print(load_library().path)
"""

SHOW_DRIVERS = """
from importlib.metadata import entry_points
from aquaflow.sources.discovery import discover
print(discover().problems)
for group, name in (("aquaflow.cameras", "video"), ("aquaflow.telemetry", "links")):
    [entry] = entry_points(group=group, name=name)
    print(entry.load().__name__)
"""


def build_requirements_are_here() -> bool:
    try:
        importlib.metadata.version("setuptools-scm")
        return int(importlib.metadata.version("setuptools").partition(".")[0]) >= 77
    except importlib.metadata.PackageNotFoundError:
        return False


pytestmark = [
    pytest.mark.ci,
    pytest.mark.skipif(
        not build_requirements_are_here(),
        reason="no setuptools >= 77 and setuptools-scm here to build a wheel with",
    ),
]


def pip(*arguments: object, cwd: Path, **environment: str) -> str:
    """Run pip and return all it says; fails with that."""
    done = subprocess.run(
        [sys.executable, "-m", "pip", *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    return said


def copy_sources(folder: Path) -> None:
    """What a wheel is built from, without compiled libraries."""
    unwanted = shutil.ignore_patterns("*.so", "__pycache__")
    for part in PARTS:
        source = ROOT / part
        if source.is_dir():
            shutil.copytree(source, folder / part, symlinks=True, ignore=unwanted)
        else:
            shutil.copy(source, folder / part)


def built_wheel(folder: Path, **environment: str) -> tuple[Path, str]:
    """The wheel of the sources in ``folder``, and the log."""
    options = ("--no-deps", "--no-build-isolation", "--no-index", "-v", "-w", folder / "dist")
    log = pip("wheel", ".", *options, cwd=folder, **environment)
    (wheel,) = (folder / "dist").iterdir()
    return wheel, log


def build_wheel(folder: Path, **environment: str) -> tuple[Path, str]:
    """A wheel from a copy of the sources, which holds a library from elsewhere; and the log."""
    copy_sources(folder)
    (folder / "aquaflow/render/native/libaquaflow_elsewhere.so").write_bytes(b"elsewhere")
    return built_wheel(folder, **environment)


def libraries(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return {Path(name).name for name in archive.namelist() if name.endswith(".so")}


def page_files(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        names = {Path(name) for name in archive.namelist()}
    return {name.name for name in names if name.parent.name == "page" and name.suffix != ".py"}


def audited_platform(wheel: Path) -> str:
    """The tag that auditwheel finds by the libraries' symbols, independently of ``setup.py``."""
    audit = [sys.executable, "-m", "auditwheel", "show", str(wheel)]
    done = subprocess.run(audit, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    said = " ".join(done.stdout.split())
    found = re.search(r'following platform tag: "(\w+)"', said)
    assert found is not None, said
    return found[1]


def renderer_of(wheel: Path, folder: Path) -> list[str]:
    """What an installed wheel renders with where there is no compiler."""
    installed = folder / "installed"
    options = ("--no-deps", "--no-index", "--target", installed)
    pip("install", wheel, *options, cwd=folder, **NO_COMPILER)
    done = subprocess.run(
        [sys.executable, "-c", SHOW_RENDERER],
        cwd=installed,
        env={**os.environ, **NO_COMPILER, "PYTHONPATH": str(installed)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.fixture(scope="module")
def without_compiler(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The wheel that is built where there is no compiler, and the log."""
    return build_wheel(tmp_path_factory.mktemp("without_compiler"), CXX=NO_COMPILER["CXX"])


def test_wheel_holds_every_variant_and_is_installed_without_a_compiler(
    quick_compiler: str, tmp_path: Path
) -> None:
    wheel, _ = build_wheel(tmp_path, CXX=quick_compiler)
    _, python, abi, platform = wheel.stem.rsplit("-", 3)
    assert (python, abi) == ("py3", "none")
    assert re.fullmatch(rf"manylinux_2_\d+_{os.uname().machine}", platform)
    assert platform == audited_platform(wheel)
    assert libraries(wheel) == {
        f"libaquaflow_{isa}.so" for isa in native.target_isas([quick_compiler])
    }
    page = ROOT / "aquaflow" / "live" / "health" / "page"
    assert page_files(wheel) == {file.name for file in page.iterdir() if file.suffix in PAGE}
    renderer, path = renderer_of(wheel, tmp_path)
    assert renderer == "cpu 0"
    assert Path(path).is_relative_to(tmp_path / "installed")


def test_a_cross_built_wheel_is_tagged_with_the_target(tmp_path: Path) -> None:
    if shutil.which(CROSS_COMPILER) is None:
        pytest.skip(f"no {CROSS_COMPILER}: no wheel is built for another processor here")
    wheel, _ = build_wheel(tmp_path, CXX=CROSS_COMPILER)
    platform = wheel.stem.rsplit("-", 1)[1]
    assert re.fullmatch(r"manylinux_2_\d+_aarch64", platform)
    assert platform == audited_platform(wheel)
    assert libraries(wheel) == {"libaquaflow_neon.so"}


def test_without_a_compiler_the_wheel_fits_every_machine_and_torch_renders(
    without_compiler: tuple[Path, str], tmp_path: Path
) -> None:
    wheel, log = without_compiler
    assert wheel.name.endswith("-py3-none-any.whl")
    assert libraries(wheel) == set()
    assert "torch renderer will be used" in log
    assert renderer_of(wheel, tmp_path) == ["tiles 1"]


def test_another_projects_drivers_on_the_path_do_not_hide_ours(
    without_compiler: tuple[Path, str], tmp_path: Path
) -> None:
    wheel, _ = without_compiler
    with zipfile.ZipFile(wheel) as archive:
        folders = {name.partition("/")[0] for name in archive.namelist()}
    assert folders == {"aquaflow", f"{wheel.name.partition('-py3')[0]}.dist-info"}
    installed, foreign = tmp_path / "installed", tmp_path / "foreign"
    pip("install", wheel, "--no-deps", "--no-index", "--target", installed, cwd=tmp_path)
    for name in ("drivers", "sim_drivers"):
        (foreign / name).mkdir(parents=True)
        (foreign / name / "__init__.py").write_text("raise ImportError('of another project')\n")
    done = subprocess.run(
        [sys.executable, "-c", SHOW_DRIVERS],
        cwd=foreign,
        env={**os.environ, "PYTHONPATH": f"{foreign}:{installed}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.splitlines() == ["[]", "VideoFile", "LinkTelemetry"], done.stderr


def test_a_checkout_of_git_is_built_with_its_drivers(tmp_path: Path) -> None:
    if shutil.which("git") is None:
        pytest.skip("no git: setuptools-scm lists no files here")
    copy_sources(tmp_path)
    author = ("-c", "user.name=one", "-c", "user.email=one@example.org")
    for command in (("init", "-q"), ("add", "."), (*author, "commit", "-q", "-m", "one")):
        subprocess.run(["git", *command], cwd=tmp_path, check=True)
    wheel, _ = built_wheel(tmp_path, CXX=NO_COMPILER["CXX"])
    with zipfile.ZipFile(wheel) as archive:
        assert "aquaflow/drivers/v4l2/abi.py" in archive.namelist()
        assert "aquaflow/recordings/video.py" in archive.namelist()


def test_a_checkout_that_lost_its_links_is_refused_in_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "aquaflow").mkdir()
    (tmp_path / "aquaflow" / "drivers").write_text("../drivers")  # as git leaves it without links
    shutil.copy(ROOT / "setup.py", tmp_path)
    done = subprocess.run(
        [sys.executable, "setup.py", "--version"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.startswith("aquaflow/drivers is no link")
