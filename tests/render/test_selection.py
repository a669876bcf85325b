"""Which renderer is chosen, and what happens where the kernels cannot be built."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from aquaflow.base.errors import AquaFlowError
from aquaflow.render import library, select_renderer
from aquaflow.render.cpu import CpuRenderer, TileRenderer
from aquaflow.render.native import build as native
from tests.render.render_scenes import HEIGHT, WIDTH, random_scene

needs_compiler = pytest.mark.skipif(native.find_compiler() is None, reason="no C++ compiler")


@pytest.fixture
def nothing_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No library beside the sources and no compiler."""
    original = library.load_library.__wrapped__
    monkeypatch.setattr(native, "find_compiler", lambda: None)
    monkeypatch.setattr(
        "aquaflow.render.cpu.load_library", lambda isa=None: original(isa, tmp_path)
    )
    return tmp_path


@pytest.mark.usefixtures("nothing_installed")
def test_without_library_and_compiler_the_torch_fallback_is_announced_once() -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        renderer = select_renderer("auto")
    assert isinstance(renderer, TileRenderer)
    assert len(caught) == 1
    assert "no C++ compiler" in str(caught[0].message)
    assert renderer(*random_scene(0).leaves(), WIDTH, HEIGHT).alpha.max() > 0


@pytest.mark.usefixtures("nothing_installed")
def test_asking_for_the_cpu_renderer_by_name_without_a_compiler_is_an_error() -> None:
    with pytest.raises(AquaFlowError, match=r"install g\+\+"):
        select_renderer("cpu")


@pytest.mark.ci
def test_a_missing_library_is_built_where_it_belongs(
    tmp_path: Path, quick_compiler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CXX", quick_compiler)
    isa = native.supported_isas()[0]
    loaded = library.load_library.__wrapped__(isa, tmp_path)
    assert loaded.path == native.library_path(isa, tmp_path)
    assert native.is_current(loaded.path)
    assert [path.name for path in tmp_path.iterdir()] == [loaded.path.name]


def test_a_library_from_other_sources_is_out_of_date(tmp_path: Path) -> None:
    stale = tmp_path / "libaquaflow_avx2.so"
    stale.write_bytes(b"\x7fELF aquaflow-source:0000000000000000")
    assert not native.is_current(stale)
    assert not native.is_current(tmp_path / "missing.so")


def test_a_compiler_that_fails_gives_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(native, "find_compiler", lambda: ["false"])
    with pytest.raises(native.BuildError, match="`false` failed"):
        native.build("sse4", tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_kernels_build_without_torch() -> None:
    code = "import sys; import aquaflow.render.native.build; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_importing_the_package_does_not_import_torch() -> None:
    code = "import sys; import aquaflow.render; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@needs_compiler
def test_auto_takes_the_compiled_kernels_with_the_threads_asked_for() -> None:
    renderer = select_renderer("cpu", threads=1)
    assert isinstance(renderer, CpuRenderer)
    assert (renderer.name, renderer.isa, renderer.threads) == (
        "cpu",
        native.supported_isas()[0],
        1,
    )
