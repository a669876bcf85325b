"""ONNX Runtime sessions: made once, on the processor that was asked for, quiet.

Asking ONNX Runtime for a GPU that is not there gives a CPU session and a warning, so what was
obtained is compared with what was asked. Threads that spin while they wait would starve tracking
and mapping on a small machine. The wheel holds a telemetry client, which is switched off.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.errors import AquaFlowError, InputError, first_line

Device: TypeAlias = Literal["auto", "cpu", "cuda", "tensorrt"]

PROVIDERS: dict[str, str] = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
}
FASTEST_FIRST = ("tensorrt", "cuda", "cpu")
LOG_ERRORS_ONLY = 3


@dataclass(frozen=True)
class RuntimeSettings:
    """Where and how networks run."""

    device: Device = "auto"
    threads: int = 1
    engine_cache: Path | None = None
    """Folder that TensorRT keeps its engines in: building one takes minutes."""


class Session:
    """One network, ready to run."""

    def __init__(self, path: Path, settings: RuntimeSettings) -> None:
        """Load ``path``.

        Raises:
            AquaFlowError: onnxruntime is not installed, or lacks the processor asked for.
            InputError: the file is no network that it can run.
        """
        ort = _onnxruntime()
        device = _device(ort, settings.device)
        options = ort.SessionOptions()
        options.intra_op_num_threads = settings.threads
        options.inter_op_num_threads = 1
        options.log_severity_level = LOG_ERRORS_ONLY
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self._session = ort.InferenceSession(
                str(path), options, providers=_providers(device, settings.engine_cache)
            )
        except Exception as error:  # onnxruntime's errors share no base of their own
            raise InputError(
                f"{path} cannot be run ({first_line(error)}); export it again"
            ) from error
        obtained = self._session.get_providers()[0]
        if obtained != PROVIDERS[device]:
            raise AquaFlowError(
                f"{path.name} was to run on {device} but onnxruntime fell back to {obtained}; "
                "repair its GPU libraries or set device: auto"
            )
        self.device = device
        self.inputs = [value.name for value in self._session.get_inputs()]
        self.outputs = [value.name for value in self._session.get_outputs()]

    def __call__(
        self, inputs: Mapping[str, npt.NDArray[Any]]
    ) -> dict[str, npt.NDArray[np.float32]]:
        """All outputs by name."""
        values = self._session.run(self.outputs, dict(inputs))
        return dict(zip(self.outputs, values, strict=True))


def _onnxruntime() -> Any:
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    try:
        import onnxruntime as ort
    except ImportError as error:
        raise AquaFlowError(
            "learned priors need onnxruntime; pip install 'aquaflow[prior]' or set prior: classical"
        ) from error
    ort.disable_telemetry_events()
    return ort


def _device(ort: Any, asked: Device) -> str:
    """The processor to use; ``auto`` takes the fastest that this onnxruntime was built for."""
    here = set(ort.get_available_providers())
    if asked == "auto":
        return next(name for name in FASTEST_FIRST if PROVIDERS[name] in here)
    if PROVIDERS[asked] not in here:
        raise AquaFlowError(
            f"onnxruntime has no {PROVIDERS[asked]}; install onnxruntime-gpu or use device: auto"
        )
    return asked


def _providers(device: str, engine_cache: Path | None) -> list[Any]:
    """The chosen one first; what it cannot do falls to the next slower one."""
    settings: dict[str, dict[str, Any]] = {
        "tensorrt": {"trt_fp16_enable": True},
        "cuda": {"device_id": 0, "cudnn_conv_algo_search": "HEURISTIC"},
        "cpu": {},
    }
    if engine_cache is not None:
        settings["tensorrt"] |= {
            "trt_engine_cache_enable": True,
            "trt_engine_cache_path": str(engine_cache),
        }
    slower = FASTEST_FIRST[FASTEST_FIRST.index(device) :]
    return [(PROVIDERS[name], settings[name]) for name in slower]
