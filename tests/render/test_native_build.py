"""How the kernels are compiled: the right variants, from any compiler, with clear failures."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from aquaflow.render import library
from aquaflow.render.cpu import CpuRenderer
from aquaflow.render.native import build as native
from aquaflow.render.reference import ReferenceRenderer
from tests.render.render_scenes import HEIGHT, WIDTH, random_scene

needs_compiler = pytest.mark.skipif(native.find_compiler() is None, reason="no C++ compiler")

V2 = "cx16 lahf_lm popcnt sse4_1 sse4_2 ssse3"
V3 = f"{V2} abm avx2 bmi1 bmi2 f16c fma movbe"
V4 = f"{V3} avx512bw avx512cd avx512dq avx512f avx512vl"


def compiler_script(folder: Path, body: str) -> list[str]:
    """A command that stands in for a compiler."""
    script = folder / "compiler"
    script.write_text(f"#!/bin/sh\n{body}\n")
    script.chmod(0o755)
    return [str(script)]


@pytest.mark.parametrize(
    ("triplet", "isas"),
    [
        ("x86_64-linux-gnu", ("avx512", "avx2", "sse4")),
        ("aarch64-unknown-linux-gnu", ("neon",)),
        ("arm64-apple-darwin23.1.0", ("neon",)),
        ("i686-linux-gnu", ()),
        ("riscv64-linux-gnu", ()),
    ],
)
def test_variants_are_those_of_the_compilers_target(
    triplet: str, isas: tuple[str, ...], tmp_path: Path
) -> None:
    assert native.target_isas(compiler_script(tmp_path, f"echo {triplet}")) == isas


def test_a_compiler_that_does_not_tell_its_target_builds_for_this_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("platform.machine", lambda: "AMD64")
    assert native.target_isas(compiler_script(tmp_path, "exit 1"))[0] == "avx512"


@pytest.mark.parametrize(
    ("flags", "isas"),
    [
        (V4, ("avx512", "avx2", "sse4")),
        (V4.replace("avx512vl", ""), ("avx2", "sse4")),  # the first AVX-512, Knights Landing
        (V3, ("avx2", "sse4")),
        (V3.replace("abm", ""), ("sse4",)),
        (V2, ("sse4",)),
        ("sse2", ()),
    ],
)
def test_a_variant_runs_where_every_instruction_it_may_hold_is_there(
    flags: str, isas: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("platform.machine", lambda: "x86_64")
    info = tmp_path / "cpuinfo"
    info.write_text(f"processor : 0\nflags\t\t: fpu {flags} ht\nprocessor : 1\n")
    assert native.supported_isas(info) == isas


def test_a_processor_that_cannot_be_looked_at_runs_the_baseline(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("platform.machine", lambda: "x86_64")
    assert native.supported_isas(tmp_path / "missing") == ("sse4",)


def test_arm_machines_run_neon(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    assert native.supported_isas(tmp_path / "missing") == ("neon",)


def test_the_first_error_of_the_compiler_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    says = "echo 'a.cpp:1: error: no such thing' >&2; echo '1 warning generated.' >&2; exit 1"
    monkeypatch.setattr(native, "find_compiler", lambda: compiler_script(tmp_path, says))
    with pytest.raises(native.BuildError, match="no such thing"):
        native.build("sse4", tmp_path / "out")


@pytest.mark.skipif(len(native.supported_isas()) < 2, reason="only one variant runs here")
@pytest.mark.ci
def test_where_the_fastest_variant_cannot_be_built_the_next_one_is_taken(
    tmp_path: Path, quick_compiler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CXX", quick_compiler)
    fastest, second = native.supported_isas()[:2]
    real = native.build

    def old_compiler(isa: str, out_dir: Path) -> Path:
        if isa == fastest:
            raise native.BuildError(f"`g++` does not know {isa}")
        return real(isa, out_dir)

    monkeypatch.setattr(native, "build", old_compiler)
    loaded = library.load_library.__wrapped__(None, tmp_path)
    assert loaded.isa == second
    with pytest.raises(library.NativeUnavailableError, match=fastest):
        library.load_library.__wrapped__(fastest, tmp_path)


def test_a_compiler_that_fails_is_asked_once_in_a_process(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = []

    def unavailable() -> None:
        asked.append(1)
        raise library.NativeUnavailableError("no kernels")

    monkeypatch.setattr(library, "load_library", unavailable)
    library.library_or_none.cache_clear()
    try:
        assert [library.library_or_none() for _ in range(3)] == [None] * 3
    finally:
        library.library_or_none.cache_clear()
    assert len(asked) == 1


@pytest.mark.skipif(shutil.which("clang++") is None, reason="no clang++")
def test_clang_builds_kernels_that_draw_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(native, "find_compiler", lambda: ["clang++"])
    original = library.load_library.__wrapped__
    monkeypatch.setattr("aquaflow.render.cpu.load_library", lambda isa: original(isa, tmp_path))
    leaves = random_scene(50).leaves()
    got = CpuRenderer(2)(*leaves, WIDTH, HEIGHT)
    wanted = ReferenceRenderer()(*leaves, WIDTH, HEIGHT)
    assert (got.image - wanted.image).abs().max() < 1e-4


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize(
    "header", sorted(native.NATIVE_DIR.glob("*.h")), ids=lambda path: path.name
)
def test_every_header_compiles_alone(header: Path) -> None:
    compiler = native.find_compiler()
    assert compiler is not None
    isa = native.target_isas(compiler)[0]
    command = [*compiler, *native.compile_flags(isa), "-fsyntax-only", "-xc++", str(header)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


def test_a_library_whose_sources_cannot_be_read_is_taken_as_it_is(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def unreadable() -> str:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(native, "source_hash", unreadable)
    library = tmp_path / "libaquaflow_sse4.so"
    assert not native.is_current(library)
    library.write_bytes(b"kernels")
    assert native.is_current(library)
