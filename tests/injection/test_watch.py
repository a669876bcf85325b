"""The harness itself: it sees the calls that it should, and its faults are what they say."""

from __future__ import annotations

import ast
import errno
import io
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.linalg
import torch

from . import callees, rewriting
from .faults import Kind, error_of, strike, without_numbers
from .plan import can_have
from .watch import Found, Site, Strike, Watch

PLACE = ("aquaflow/x.py", "f")


@pytest.mark.parametrize(
    ("callee", "named"),
    [
        (cv2.resize, ("cv2", "cv2.resize")),
        (cv2.SIFT.create, ("cv2", "cv2.SIFT.create")),
        (cv2.createCLAHE().apply, ("cv2", "cv2.CLAHE.apply")),
        (np.linalg.svd, ("numpy.linalg", "numpy.linalg.svd")),
        (scipy.linalg.inv, ("scipy", "scipy.linalg.inv")),
        (torch.ones(1).numpy, ("torch", "torch.Tensor.numpy")),
        (torch.nn.functional.pad, ("torch", "torch.nn.functional.pad")),
        (Path("x").open, ("file", "pathlib.Path.open")),
        (open, ("file", "io.open")),
        (np.ones(1).tofile, ("file", "numpy.ndarray.tofile")),
    ],
)
def test_a_call_into_a_library_is_known_by_its_name(callee: object, named: tuple[str, str]) -> None:
    assert callees.library_of(callee) == named


@pytest.mark.parametrize("callee", [len, np.sum, io.BytesIO().write, Path("x").with_name, print])
def test_other_calls_are_left_alone(callee: object) -> None:
    assert callees.library_of(callee) is None


def test_a_rewritten_function_passes_its_calls_and_operators_through_the_watch() -> None:
    watch = Watch(active=True)
    source = "def f(a, *rest, **named):\n    return inverse(a, *rest, **named) @ a\n"
    tree = rewriting._Rewriter(PLACE[0]).visit(ast.parse(source))
    names = {
        rewriting.CALLED: watch.called, rewriting.OPERATED: watch.operated,
        "inverse": torch.linalg.inv,
    }  # fmt: skip
    exec(compile(ast.fix_missing_locations(tree), "x", "exec"), names)
    torch.testing.assert_close(names["f"](torch.eye(2)), torch.eye(2))
    assert [site.callee for site in watch.found] == ["torch.linalg_inv", "torch.Tensor.MatMult"]
    assert all((site.file, site.function) == PLACE for site in watch.found)


def test_only_the_planned_call_fails_and_only_once() -> None:
    site = Site("numpy.linalg", "numpy.linalg.norm", *PLACE)
    watch = Watch(Strike(site, 2, Kind.RAISE), active=True)
    ones = np.ones(4)
    assert watch.called(PLACE, np.linalg.norm, ones) == 2.0
    with pytest.raises(np.linalg.LinAlgError):
        watch.called(PLACE, np.linalg.norm, ones)
    assert watch.called(PLACE, np.linalg.norm, ones) == 2.0
    assert watch.struck is not None


def test_a_fault_of_numbers_keeps_shape_and_type() -> None:
    found = without_numbers((np.ones((2, 3), np.float32), np.ones(2, np.uint8)))
    assert np.isnan(found[0]).all()
    assert found[0].shape == (2, 3)
    assert found[0].dtype == np.float32
    np.testing.assert_array_equal(found[1], 1)


def test_a_tensor_without_numbers_still_has_its_graph() -> None:
    x = torch.ones(2, requires_grad=True)
    assert without_numbers(2.0 * x).grad_fn is not None


def test_each_library_fails_with_an_error_of_its_own() -> None:
    assert isinstance(error_of("cv2"), cv2.error)
    assert error_of("file").errno == errno.EIO  # type: ignore[attr-defined]
    with pytest.raises(OSError, match="No space"):
        strike(Kind.FULL, "file")


def test_only_what_is_written_meets_a_full_disk() -> None:
    read, write = (Site("file", f"io.{name}", *PLACE) for name in ("read", "write"))
    assert can_have(Kind.FULL, write, Found(1))
    assert not can_have(Kind.FULL, read, Found(1))
    assert not can_have(Kind.NAN, read, Found(1))
