"""LPIPS from its files alone, on weights that are drawn here."""

from __future__ import annotations

import hashlib
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from aquaflow.render import lpips
from aquaflow.render.lpips import BACKBONES, Backbone, Lpips, load_lpips

CHANNELS = {"vgg": (4, 4, 5, 5, 6), "alex": (4, 5, 6, 6, 5)}
KERNELS = {"vgg": (3, 3, 3, 3, 3), "alex": (11, 5, 3, 3, 3)}


def drawn(name: str, dtype: torch.dtype = torch.float32) -> tuple[dict[str, Tensor], ...]:
    """Weights of the shapes' order, with few channels."""
    random = torch.Generator().manual_seed(4)
    features, linear, before = dict[str, Tensor](), dict[str, Tensor](), 3
    blocks = zip(BACKBONES[name].blocks, CHANNELS[name], KERNELS[name], strict=True)
    for block, (numbers, channels, kernel) in enumerate(blocks):
        for number in numbers:
            shape = (channels, before, kernel, kernel)
            weight = torch.randn(shape, generator=random) / (before * kernel**2) ** 0.5
            features[f"features.{number}.weight"] = weight.to(dtype)
            features[f"features.{number}.bias"] = torch.zeros(channels, dtype=dtype)
            before = channels
        linear[f"lin{block}.model.1.weight"] = torch.rand(1, channels, 1, 1, generator=random).to(
            dtype
        )
    return features, linear


def pictures() -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(2)
    image = random.uniform(size=(72, 96, 3))
    return image, np.clip(image + random.normal(0.0, 0.1, image.shape), 0, 1)


def as_published(name: str, a: np.ndarray, b: np.ndarray) -> float:
    """The paper's sum, layer by layer as torchvision lists them."""
    features, linear = drawn(name, torch.float64)
    kernels = {"vgg": "CRCRP" * 2 + "CRCRCRP" * 2 + "CRCRCR", "alex": "CRPCRPCRCRCR"}[name]
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])

    def taps(picture: np.ndarray) -> list[Tensor]:
        there = torch.from_numpy((2.0 * picture - 1.0 - shift) / scale).permute(2, 0, 1)[None]
        last = {block[-1] for block in BACKBONES[name].blocks}
        found, newest = [], -1
        for number, kind in enumerate(kernels):
            if kind == "C":
                weight = features[f"features.{number}.weight"]
                bias = features[f"features.{number}.bias"]
                first = name == "alex" and number == 0
                padding = 2 if first else weight.shape[-1] // 2
                there = torch.nn.functional.conv2d(there, weight, bias, 4 if first else 1, padding)
                newest = number
            elif kind == "R":
                there = there.clamp(min=0.0)
                if newest in last:
                    found.append(there / (there.pow(2).sum(1, keepdim=True).sqrt() + 1e-10))
            else:
                there = torch.nn.MaxPool2d(2 if name == "vgg" else 3, 2)(there)
        return found

    total = 0.0
    for number, (x, y) in enumerate(zip(taps(a), taps(b), strict=True)):
        weights = linear[f"lin{number}.model.1.weight"].reshape(1, -1, 1, 1)
        total += float((weights * (x - y) ** 2).sum(1).mean())
    return total


@pytest.mark.parametrize("name", BACKBONES)
def test_the_distance_is_the_published_sum_over_layers(name: str) -> None:
    a, b = pictures()
    measured = Lpips(BACKBONES[name], *drawn(name))(a, b)
    assert measured == pytest.approx(as_published(name, a, b), rel=1e-4)
    assert measured > 0.0
    assert Lpips(BACKBONES[name], *drawn(name))(a, a) == 0.0


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with weights of both backbones, and a package with those of their features."""
    package = tmp_path / "site" / "lpips"
    (package / "weights" / "v0.1").mkdir(parents=True)
    (package / "__init__.py").write_text("raise AssertionError('its code is not run')")
    monkeypatch.syspath_prepend(str(package.parent))
    monkeypatch.delitem(sys.modules, "lpips", raising=False)
    known: dict[str, Backbone] = {}
    for name, backbone in BACKBONES.items():
        features, linear = drawn(name)
        torch.save(features, tmp_path / "made.pth")
        digits = hashlib.sha256((tmp_path / "made.pth").read_bytes()).hexdigest()
        file = f"{name}-{digits[:8]}.pth"
        (tmp_path / "made.pth").rename(tmp_path / file)
        own = package / "weights" / "v0.1" / f"{name}.pth"
        torch.save(linear, own)
        known[name] = replace(
            backbone, file=file, linear=hashlib.sha256(own.read_bytes()).hexdigest()
        )
    monkeypatch.setattr(lpips, "BACKBONES", known)
    lpips._load.cache_clear()
    return tmp_path


def test_both_backbones_are_read_from_a_folder_and_no_code_of_the_package_is_run(
    files: Path,
) -> None:
    networks, reason = load_lpips(files)
    assert reason is None
    a, b = pictures()
    assert {name: network(a, b) for name, network in networks.items()} == {
        name: Lpips(BACKBONES[name], *drawn(name))(a, b) for name in BACKBONES
    }


def test_one_backbone_alone_is_used_and_the_other_named(files: Path) -> None:
    gone = files / lpips.BACKBONES["vgg"].file
    gone.unlink()
    networks, reason = load_lpips(files)
    assert set(networks) == {"alex"}
    assert reason == f"weights of LPIPS are not at {gone}"


def test_a_damaged_file_is_named_and_not_used(files: Path) -> None:
    damaged = files / lpips.BACKBONES["alex"].file
    content = bytearray(damaged.read_bytes())
    content[-1] ^= 1
    damaged.write_bytes(content)
    networks, reason = load_lpips(files)
    assert set(networks) == {"vgg"}
    assert reason is not None
    assert f"{damaged} is damaged or another file" in reason


def test_a_file_that_may_not_be_read_is_named_and_costs_its_backbone_alone(
    files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed, whole = files / lpips.BACKBONES["vgg"].file, Path.open

    def refused(path: Path, *arguments: Any) -> Any:
        if path == closed:
            raise PermissionError(13, "Permission denied", str(path))
        return whole(path, *arguments)

    monkeypatch.setattr(Path, "open", refused)
    networks, reason = load_lpips(files)
    assert set(networks) == {"alex"}
    assert reason is not None
    assert f"{closed} cannot be read" in reason


def test_without_the_package_of_its_weights_it_says_what_installs_them(
    files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: Any = lpips.importlib.util.find_spec
    monkeypatch.setattr(
        lpips.importlib.util, "find_spec", lambda name: None if name == "lpips" else found(name)
    )
    networks, reason = load_lpips(files)
    assert networks == {}
    assert reason is not None
    assert "pip install --no-deps lpips" in reason


def test_without_a_folder_torchs_own_is_looked_into_and_nothing_is_downloaded(
    files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(files / "none"))
    networks, reason = load_lpips(None)
    assert networks == {}
    assert reason is not None
    assert str(files / "none" / "hub" / "checkpoints") in reason
