"""ONNX Runtime sessions: made once, on the processor that was asked for, quiet.

Asking ONNX Runtime for a GPU that is not there gives a CPU session and a warning, so what was
obtained is compared with what was asked. Threads that spin while they wait would starve tracking
and mapping on a small machine. The wheel holds a telemetry client, which is switched off.
"""

from __future__ import annotations

import ctypes
import logging
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import AquaFlowError, InputError, first_line, reason_of

log = logging.getLogger(__name__)

Device: TypeAlias = Literal["auto", "cpu", "cuda", "tensorrt"]
Precision: TypeAlias = Literal["auto", "fp32", "fp16", "int8"]

PROVIDERS: dict[str, str] = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
}
"""onnxruntime's names of the devices."""
FASTEST_FIRST = ("tensorrt", "cuda", "cpu")
"""The order in which ``auto`` tries devices."""
LOG_ERRORS_ONLY = 3
"""onnxruntime's severity level from which it prints."""

TENSORRT_WORKSPACE_BYTES = 1 << 30
"""Scratch memory of TensorRT's kernels: a Jetson shares its memory with everything else."""


@dataclass(frozen=True)
class RuntimeSettings:
    """Where and how networks run."""

    device: Device = "auto"
    precision: Precision = "auto"
    threads: int = 1
    engine_cache: Path | None = None
    """Folder that TensorRT keeps its engines in, for building one takes minutes; None: the one in
    the user's cache directory."""


class NetworkSession:
    """One network, ready to run."""

    def __init__(self, path: Path, settings: RuntimeSettings) -> None:
        """Load ``path``.

        Raises:
            AquaFlowError: onnxruntime is not installed, or lacks the processor asked for.
            InputError: the file is no network that it can run.
        """
        ort = _onnxruntime()
        device = _device(ort, settings.device)
        if settings.precision == "fp16" and device != "tensorrt":
            raise AquaFlowError(
                f"precision fp16 is TensorRT's and {path.name} was to run on {device}; use device: "
                "tensorrt or precision: auto"
            )
        options = ort.SessionOptions()
        options.intra_op_num_threads = settings.threads
        options.inter_op_num_threads = 1
        options.log_severity_level = LOG_ERRORS_ONLY
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        if device != "cpu":
            _load_gpu_libraries(ort)
        try:
            with redirect_stdout(sys.stderr):  # it prints there what fails, and --json is for us
                self._session = ort.InferenceSession(
                    str(path), options, providers=_providers(device, settings)
                )
        except Exception as error:  # onnxruntime's errors share no base of their own
            raise InputError(
                f"{path} cannot be run ({reason_of(error)}); export it again"
            ) from error
        self.device = _obtain(ort, self._session, device, settings.device, path.name)
        self.inputs = {value.name: tuple(value.shape) for value in self._session.get_inputs()}
        """Shape of each; a name in it is a size that may change."""
        self.outputs = [value.name for value in self._session.get_outputs()]

    def __call__(
        self,
        inputs: Mapping[str, npt.NDArray[Any]],  # by name, shapes as the network's
    ) -> dict[str, npt.NDArray[np.float32]]:
        """All outputs by name, in the processor's own memory."""
        return dict(self.outputs_of(inputs))

    def outputs_of(
        self,
        inputs: Mapping[str, npt.NDArray[Any]],  # by name, shapes as the network's
    ) -> Mapping[str, npt.NDArray[np.float32]]:
        """All outputs by name; what is on a GPU is copied from there when it is first asked for."""
        if self.device == "cpu":
            values = self._session.run(self.outputs, dict(inputs))
            return dict(zip(self.outputs, values, strict=True))
        return OutputsOnDevice(self.on_device(inputs))

    def on_device(self, inputs: Mapping[str, Any]) -> dict[str, Any]:
        """All outputs by name, left where they were computed, as onnxruntime's own values.

        Inputs are arrays or such values: what one network hands to another is not copied there and
        back (IO binding).
        """
        binding = self._session.io_binding()
        for name, value in inputs.items():
            if isinstance(value, np.ndarray):
                binding.bind_cpu_input(name, value)
            else:
                binding.bind_ortvalue_input(name, value)
        memory = "cpu" if self.device == "cpu" else "cuda"
        for name in self.outputs:
            binding.bind_output(name, memory)
        self._session.run_with_iobinding(binding)
        return dict(zip(self.outputs, binding.get_outputs(), strict=True))


class OutputsOnDevice(Mapping[str, npt.NDArray[np.float32]]):
    """Outputs that lie where they were computed; each is copied at most once."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = values
        self._copied: dict[str, npt.NDArray[np.float32]] = {}

    def __getitem__(self, name: str) -> npt.NDArray[np.float32]:
        if name not in self._copied:
            self._copied[name] = self._values[name].numpy()
        return self._copied[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)


def _onnxruntime() -> Any:
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    try:
        import onnxruntime as ort
    except ImportError as error:
        raise AquaFlowError(
            "learned priors need onnxruntime; pip install 'aquaflow[prior]' "
            "or set prior.kind: classical"
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


def _load_gpu_libraries(ort: Any) -> None:
    """Load CUDA and cuDNN from the packages that pip installed, as torch brings them.

    onnxruntime looks for them where the system has libraries, unless torch was imported before.
    """
    if hasattr(ort, "preload_dlls"):  # since 1.21
        with redirect_stdout(sys.stderr):
            ort.preload_dlls()


def _not_loading(ort: Any, device: str) -> str:
    """Which library of a provider is missing, in brackets; empty if none is."""
    library = Path(ort.__file__).parent / "capi" / f"libonnxruntime_providers_{device}.so"
    try:
        ctypes.CDLL(str(library), mode=os.RTLD_LAZY)
    except OSError as error:
        return f" ({first_line(error)})"
    return ""


def _obtain(ort: Any, session: Any, wanted: str, asked: Device, what: str) -> str:
    """The processor that the session runs on; a library that does not load makes it a slower one.

    Raises:
        AquaFlowError: it is not the one that was asked for by name.
    """
    provider = session.get_providers()[0]
    device = next((name for name in FASTEST_FIRST if PROVIDERS[name] == provider), provider)
    if device == wanted:
        return device
    reason = _not_loading(ort, wanted)
    if asked != "auto":
        raise AquaFlowError(
            f"{what} was to run on {wanted} but onnxruntime fell back to {provider}{reason}; "
            "repair its GPU libraries or set device: auto"
        )
    log.warning("%s runs on %s: onnxruntime cannot use %s here%s", what, device, wanted, reason)
    return device


def _providers(device: str, settings: RuntimeSettings) -> list[Any]:
    """The chosen one first; what it cannot do falls to the next slower one.

    An engine fits one GPU and one TensorRT: onnxruntime names its file after both, so a folder may
    serve several machines.
    """
    options: dict[str, dict[str, Any]] = {
        "tensorrt": {
            "trt_fp16_enable": settings.precision != "fp32",
            "trt_max_workspace_size": TENSORRT_WORKSPACE_BYTES,
        },
        "cuda": {
            "device_id": 0,
            "cudnn_conv_algo_search": "HEURISTIC",
            "use_tf32": settings.precision != "fp32",
        },
        "cpu": {},
    }
    folder = _engine_folder(settings.engine_cache) if device == "tensorrt" else None
    if folder is not None:
        options["tensorrt"] |= {
            "trt_engine_cache_enable": True,
            "trt_engine_cache_path": str(folder),
            "trt_timing_cache_enable": True,
            "trt_timing_cache_path": str(folder),
        }
    slower = FASTEST_FIRST[FASTEST_FIRST.index(device) :]
    return [(PROVIDERS[name], options[name]) for name in slower]


def _engine_folder(asked: Path | None) -> Path | None:
    """The folder for engines; None, with a warning, where it cannot be made."""
    caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = asked or Path(caches) / "aquaflow" / "tensorrt"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        log.warning(
            "TensorRT builds its engines at every start: %s cannot be made (%s); set "
            "prior.engine_cache",
            folder,
            reason_of(error),
        )
        return None
    return folder


# --------------------------------------------------------------------------------------------------
# The encoder with 8-bit weights and activations (QDQ, per channel), calibrated on pictures.

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
