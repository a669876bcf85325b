"""A GPU that is none: sessions that run on the CPU, say otherwise, and may be wrong."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from aquaflow.prior.runtime import PROVIDERS

Fault = Callable[[str, np.ndarray], np.ndarray]


class PretendedGpu:
    """onnxruntime with a provider that is not there; ``fault`` is what it does to each output."""

    def __init__(self, device: str, fault: Fault) -> None:
        import onnxruntime

        self._real, self._device, self._fault = onnxruntime, device, fault
        self.SessionOptions = onnxruntime.SessionOptions

    def get_available_providers(self) -> list[str]:
        return [PROVIDERS[self._device], PROVIDERS["cpu"]]

    def InferenceSession(self, path: str, options: Any, providers: list[Any]) -> Any:
        session = self._real.InferenceSession(path, options, providers=[PROVIDERS["cpu"]])
        asked = providers[0][0]
        if asked == PROVIDERS["cpu"]:
            return session
        return SimpleNamespace(
            get_providers=lambda: [asked],
            get_inputs=session.get_inputs,
            get_outputs=session.get_outputs,
            io_binding=lambda: _Binding(session, self._fault),
            run_with_iobinding=lambda binding: None,
        )


class _Binding:
    def __init__(self, session: Any, fault: Fault) -> None:
        self._session, self._fault = session, fault
        self._inputs: dict[str, np.ndarray] = {}
        self._outputs: list[str] = []

    def bind_cpu_input(self, name: str, array: np.ndarray) -> None:
        self._inputs[name] = array

    def bind_output(self, name: str, memory: str) -> None:
        self._outputs.append(name)

    def get_outputs(self) -> list[Any]:
        values = self._session.run(self._outputs, self._inputs)
        pairs = zip(self._outputs, values, strict=True)
        return [
            SimpleNamespace(numpy=lambda name=name, x=x: self._fault(name, x)) for name, x in pairs
        ]
