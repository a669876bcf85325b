"""The encoder with 8-bit weights and activations (QDQ, per channel), calibrated on pictures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import AquaFlowError

INT8_ENCODER = "encoder_int8.onnx"
"""File of the encoder in 8 bits, next to the one in 32."""


def quantise(
    encoder: Path,
    out: Path,
    pictures: Sequence[npt.NDArray[np.float32]],  # [1, 3, H, W] in [0, 1], sides multiples of 16
) -> None:
    """Write ``encoder``'s convolutions in 8 bits to ``out``; ranges are those that ``pictures``
    reach. Local contrast normalisation and the descriptors' length stay in 32 bits.

    Raises:
        AquaFlowError: onnx or onnxruntime is not installed.
    """
    try:
        from onnxruntime.quantization import (
            CalibrationDataReader,
            CalibrationMethod,
            QuantFormat,
            QuantType,
            quantize_static,
        )
        from onnxruntime.quantization.shape_inference import quant_pre_process
    except ImportError as error:
        raise AquaFlowError(
            "8-bit export needs onnx and onnxruntime; pip install 'aquaflow[prior,export]'"
        ) from error

    class Pictures(CalibrationDataReader):  # type: ignore[misc]
        """One picture after the other."""

        def __init__(self) -> None:
            self.left: Iterator[npt.NDArray[np.float32]] = iter(pictures)

        def get_next(self) -> dict[str, npt.NDArray[np.float32]] | None:
            picture = next(self.left, None)
            return None if picture is None else {"image": picture}

    with TemporaryDirectory() as scratch:
        prepared = Path(scratch) / "prepared.onnx"
        quant_pre_process(str(encoder), str(prepared), skip_symbolic_shape=True)
        quantize_static(
            str(prepared),
            str(out),
            Pictures(),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=["Conv"],
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            calibrate_method=CalibrationMethod.MinMax,
        )
