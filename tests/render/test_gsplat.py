"""What the CUDA renderer says where it cannot draw; pictures are compared where a GPU is."""

from __future__ import annotations

import sys
from importlib import metadata
from types import ModuleType

import pytest
import torch

from aquaflow import render
from aquaflow.base.errors import AquaFlowError
from aquaflow.render import gsplat, select_renderer
from aquaflow.render.cpu import CpuRenderer
from aquaflow.render.native import build as native
from tests.render.render_scenes import (
    NAMES,
    draw_and_differentiate,
    random_scene,
    reference,
    relative_error,
)


class Installed:
    """A machine with a CUDA device and a gsplat of our making."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.monkeypatch = monkeypatch
        monkeypatch.setattr("torch.cuda.is_available", lambda: True)
        self.version("1.5.3")
        self.kernels(object())

    def version(self, version: str | None) -> None:
        def of(name: str) -> str:
            if version is None:
                raise metadata.PackageNotFoundError(name)
            return version

        self.monkeypatch.setattr(metadata, "version", of)

    def kernels(self, compiled: object) -> None:
        """``gsplat.cuda._backend`` with ``compiled`` as its kernels."""
        backend = ModuleType("gsplat.cuda._backend")
        backend.__dict__["_C"] = compiled
        for name in ("gsplat", "gsplat.cuda"):
            self.monkeypatch.setitem(sys.modules, name, ModuleType(name))
        self.monkeypatch.setitem(sys.modules, backend.__name__, backend)


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Installed:
    return Installed(monkeypatch)


def refusal() -> str:
    """What asking for gsplat by name is answered; one sentence."""
    with pytest.raises(AquaFlowError) as refused:
        select_renderer("gsplat")
    said = str(refused.value)
    assert not gsplat.available()
    assert "\n" not in said
    assert said.endswith(".")
    return said


@pytest.mark.usefixtures("installed")
def test_nothing_is_missing_where_all_is_there() -> None:
    assert gsplat.missing() is None
    assert isinstance(select_renderer("gsplat"), gsplat.GsplatRenderer)
    assert render._gpu_renderers(None)[0] is gsplat.GsplatRenderer  # which auto measures


def test_without_a_cuda_device_the_cpu_is_named(
    installed: Installed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert "CUDA device" in refusal()
    assert "renderer cpu" in refusal()


def test_without_the_package_its_installation_is_named(installed: Installed) -> None:
    installed.version(None)
    assert "pip install --no-deps 'gsplat>=1.5'" in refusal()


@pytest.mark.parametrize("version", ["1.4.0", "0.1.13"])
def test_an_old_package_is_named_with_its_version(installed: Installed, version: str) -> None:
    installed.version(version)
    assert f"gsplat {version} is too old" in refusal()


@pytest.mark.parametrize("version", ["1.5", "1.5.3+pt24cu124", "1.10.0", "2.0.0rc1"])
def test_newer_packages_are_taken(installed: Installed, version: str) -> None:
    installed.version(version)
    assert gsplat.missing() is None


def test_a_package_without_kernels_names_the_cuda_toolkit(installed: Installed) -> None:
    installed.kernels(None)
    assert "no CUDA kernels" in refusal()
    assert "nvcc" in refusal()


def test_kernels_that_do_not_compile_give_the_first_line_of_the_cause(
    installed: Installed, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Failing(ModuleType):
        def __getattr__(self, name: str) -> object:
            raise RuntimeError("ninja: build stopped\nlong log")

    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", Failing("gsplat.cuda._backend"))
    assert "(ninja: build stopped)" in refusal()


def test_what_the_package_says_while_it_compiles_is_not_among_our_output(
    installed: Installed, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Compiling(ModuleType):
        def __getattr__(self, name: str) -> object:
            print("Setting up CUDA")
            return object()

    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", Compiling("gsplat.cuda._backend"))
    assert gsplat.missing() is None
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "Setting up CUDA" in printed.err


@pytest.mark.skipif(native.find_compiler() is None, reason="no C++ compiler")
def test_auto_takes_the_cpu_where_gsplat_cannot_draw(installed: Installed) -> None:
    installed.kernels(None)
    assert isinstance(select_renderer("auto"), CpuRenderer)


@pytest.mark.skipif(gsplat.missing() is not None, reason=f"no GPU to draw on: {gsplat.missing()}")
def test_gsplat_agrees_with_the_reference_within_a_grey_level() -> None:
    scene = random_scene(0)
    wanted, wanted_gradients = reference(scene)
    got, gradients = draw_and_differentiate(gsplat.GsplatRenderer(), scene)
    assert (got.alpha.cpu() - wanted.alpha).abs().max() < 1 / 255
    assert (got.image.cpu() - wanted.image).abs().max() < 4 / 255  # ranges reach 4 m
    for key, gradient, expected in zip(NAMES, gradients, wanted_gradients, strict=True):
        assert torch.isfinite(gradient).all(), key
        assert relative_error(gradient.cpu(), expected) < 0.05, key
