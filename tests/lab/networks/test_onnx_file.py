"""What the exporter to ONNX raises reaches the user as what it was."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from aquaflow.lab.networks.onnx_file import write_onnx

pytestmark = pytest.mark.usefixtures("onnxscript")


def failing_with(cause: BaseException) -> Any:
    def export(*_: object, **__: object) -> None:
        try:
            raise cause
        except BaseException as error:
            raise RuntimeError("the exporter's own error") from error

    return export


@pytest.mark.parametrize("cause", [KeyboardInterrupt(), ValueError("a bad graph")])
def test_ctrl_c_within_the_exporter_stays_ctrl_c_and_errors_stay_errors(
    cause: BaseException, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(torch.onnx, "export", failing_with(cause))
    expected = KeyboardInterrupt if isinstance(cause, KeyboardInterrupt) else RuntimeError
    with pytest.raises(expected):
        write_onnx(torch.nn.Identity(), (torch.zeros(1),), ["x"], ["y"], tmp_path / "x.onnx")
