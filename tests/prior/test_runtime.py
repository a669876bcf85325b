"""Sessions on other machines' processors, pretended: what was asked for is what runs, or is said.

The sessions are false; how they are asked for, and what is made of their answers, is not.
"""

from __future__ import annotations

import logging
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from aquaflow.base.errors import AquaFlowError
from aquaflow.prior import runtime
from aquaflow.prior.runtime import PROVIDERS, NetworkSession, RuntimeSettings

GPU = [PROVIDERS[name] for name in ("tensorrt", "cuda", "cpu")]


class Options:
    """Session options that remember."""

    def __init__(self) -> None:
        self.entries: dict[str, str] = {}

    def add_session_config_entry(self, key: str, value: str) -> None:
        self.entries[key] = value


class OnGpu:
    """A value in the GPU's memory."""

    def __init__(self, array: np.ndarray) -> None:
        self.array = array

    def numpy(self) -> np.ndarray:
        return self.array


class Binding:
    """Remembers what lies where; a run doubles the input."""

    def __init__(self) -> None:
        self.inputs: dict[str, Any] = {}
        self.outputs: dict[str, str] = {}

    def bind_cpu_input(self, name: str, array: np.ndarray) -> None:
        self.inputs[name] = array

    def bind_ortvalue_input(self, name: str, value: OnGpu) -> None:
        self.inputs[name] = value

    def bind_output(self, name: str, memory: str) -> None:
        self.outputs[name] = memory

    def get_outputs(self) -> list[OnGpu]:
        [value] = self.inputs.values()
        return [OnGpu(2.0 * (value.array if isinstance(value, OnGpu) else value))]


class Pretended:
    """An onnxruntime with GPU providers, whose sessions run where ``obtained`` says."""

    SessionOptions = Options
    __file__ = "/nowhere/onnxruntime/__init__.py"

    def __init__(self, available: list[str], obtained: str) -> None:
        self.available, self.obtained = available, obtained
        self.bindings: list[Binding] = []
        self.loaded = 0

    def preload_dlls(self) -> None:
        print("Failed to load libcufft")
        self.loaded += 1

    def get_available_providers(self) -> list[str]:
        return self.available

    def InferenceSession(self, path: str, options: Options, providers: list[Any]) -> Any:
        self.options, self.providers = options, providers
        print("*** EP Error ***")
        value = SimpleNamespace(name="x", shape=[1, 3, "height", 320])
        return SimpleNamespace(
            get_providers=lambda: [self.obtained],
            get_inputs=lambda: [value],
            get_outputs=lambda: [SimpleNamespace(name="y")],
            io_binding=self._bind,
            run_with_iobinding=lambda binding: None,
            run=lambda names, inputs: [2.0 * inputs["x"]],
        )

    def _bind(self) -> Binding:
        self.bindings.append(Binding())
        return self.bindings[-1]


@pytest.fixture(autouse=True)
def no_cache_of_the_users(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def session(
    monkeypatch: pytest.MonkeyPatch, pretended: Pretended, **settings: Any
) -> NetworkSession:
    monkeypatch.setattr(runtime, "_onnxruntime", lambda: pretended)
    return NetworkSession(Path("encoder.onnx"), RuntimeSettings(**settings))


@pytest.mark.parametrize(
    ("available", "expected"), [(GPU, "tensorrt"), (GPU[1:], "cuda"), (GPU[2:], "cpu")]
)
def test_auto_takes_the_fastest_that_is_there(
    monkeypatch: pytest.MonkeyPatch, available: list[str], expected: str
) -> None:
    pretended = Pretended(available, available[0])
    assert session(monkeypatch, pretended).device == expected
    assert [name for name, _ in pretended.providers] == available


def test_auto_takes_what_it_gets_and_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        found = session(monkeypatch, Pretended(GPU, PROVIDERS["cpu"]))
    assert found.device == "cpu"
    assert "runs on cpu: onnxruntime cannot use tensorrt here" in caplog.text


def test_a_processor_asked_for_by_name_is_that_or_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(AquaFlowError, match="was to run on tensorrt but onnxruntime fell back"):
        session(monkeypatch, Pretended(GPU, PROVIDERS["cuda"]), device="tensorrt")


@pytest.mark.parametrize("device", ["cuda", "tensorrt"])
def test_the_library_that_a_fall_back_is_for_is_named(
    monkeypatch: pytest.MonkeyPatch, device: str
) -> None:
    library = rf"libonnxruntime_providers_{device}\.so: cannot open shared object file"
    with pytest.raises(AquaFlowError, match=rf"fell back to CPUExecutionProvider \(.*{library}"):
        session(monkeypatch, Pretended(GPU, PROVIDERS["cpu"]), device=device)


def test_a_fall_back_whose_libraries_load_names_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("ctypes.CDLL", lambda path, mode: None)
    with pytest.raises(AquaFlowError, match="fell back to CPUExecutionProvider; repair"):
        session(monkeypatch, Pretended(GPU, PROVIDERS["cpu"]), device="cuda")


@pytest.mark.parametrize("device", ["cpu", "cuda", "tensorrt"])
def test_libraries_that_pip_installed_are_loaded_for_a_gpu(
    monkeypatch: pytest.MonkeyPatch, device: str
) -> None:
    pretended = Pretended(GPU, PROVIDERS[device])
    session(monkeypatch, pretended, device=device)
    assert pretended.loaded == (device != "cpu")


def test_what_onnxruntime_prints_is_not_among_our_output(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    session(monkeypatch, Pretended(GPU, PROVIDERS["cuda"]))
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err == "Failed to load libcufft\n*** EP Error ***\n"


def test_tensorrt_runs_in_half_precision_in_bounded_memory_and_keeps_what_it_built(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pretended = Pretended(GPU, PROVIDERS["tensorrt"])
    session(monkeypatch, pretended, device="tensorrt", engine_cache=tmp_path)
    options = dict(pretended.providers)[PROVIDERS["tensorrt"]]
    assert options["trt_fp16_enable"] is True
    assert options["trt_max_workspace_size"] == runtime.TENSORRT_WORKSPACE_BYTES
    assert options["trt_engine_cache_enable"] is True
    assert options["trt_engine_cache_path"] == options["trt_timing_cache_path"] == str(tmp_path)


def test_without_a_folder_engines_are_kept_in_the_users_cache(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    pretended = Pretended(GPU, PROVIDERS["tensorrt"])
    session(monkeypatch, pretended)
    folder = tmp_path / "aquaflow" / "tensorrt"
    assert dict(pretended.providers)[PROVIDERS["tensorrt"]]["trt_engine_cache_path"] == str(folder)
    assert folder.is_dir()


def test_without_a_cache_that_can_be_written_no_engine_is_kept_and_that_is_said(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    pretended = Pretended(GPU, PROVIDERS["tensorrt"])
    with caplog.at_level(logging.WARNING):
        session(monkeypatch, pretended)
    assert not any("cache" in key for key in dict(pretended.providers)[PROVIDERS["tensorrt"]])
    assert "set prior.engine_cache" in caplog.text


def test_no_folder_for_engines_is_made_where_there_are_none(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    session(monkeypatch, Pretended(GPU, PROVIDERS["cuda"]), device="cuda")
    assert not list(tmp_path.iterdir())


def test_32_bits_that_are_asked_for_are_not_rounded(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pretended = Pretended(GPU, PROVIDERS["tensorrt"])
    session(monkeypatch, pretended, precision="fp32", engine_cache=tmp_path)
    options = dict(pretended.providers)
    assert options[PROVIDERS["tensorrt"]]["trt_fp16_enable"] is False
    assert options[PROVIDERS["cuda"]]["use_tf32"] is False


@pytest.mark.parametrize("device", ["cuda", "cpu"])
def test_16_bits_that_cannot_be_had_are_an_error(
    monkeypatch: pytest.MonkeyPatch, device: str
) -> None:
    with pytest.raises(AquaFlowError, match=r"fp16 is TensorRT's and encoder\.onnx"):
        session(monkeypatch, Pretended(GPU, PROVIDERS[device]), device=device, precision="fp16")


def test_only_what_is_asked_for_is_copied_from_a_gpu_and_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    copies = []
    copied = OnGpu.numpy
    monkeypatch.setattr(OnGpu, "numpy", lambda self: copies.append(1) or copied(self))
    network = session(monkeypatch, Pretended(GPU, PROVIDERS["cuda"]), device="cuda")
    outputs = network.outputs_of({"x": np.float32([1.0])})
    assert (list(outputs), len(outputs), copies) == (["y"], 1, [])
    for _ in range(2):
        np.testing.assert_array_equal(outputs["y"], [2.0])
    assert len(copies) == 1


def test_threads_are_as_asked_and_never_spin(monkeypatch: pytest.MonkeyPatch) -> None:
    pretended = Pretended(GPU[2:], PROVIDERS["cpu"])
    session(monkeypatch, pretended, threads=3)
    assert pretended.options.intra_op_num_threads == 3
    assert pretended.options.entries["session.intra_op.allow_spinning"] == "0"


def test_shapes_of_inputs_are_known(monkeypatch: pytest.MonkeyPatch) -> None:
    found = session(monkeypatch, Pretended(GPU[2:], PROVIDERS["cpu"]))
    assert found.inputs == {"x": (1, 3, "height", 320)}


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_what_runs_on_a_gpu_comes_back_as_what_runs_on_the_cpu(
    monkeypatch: pytest.MonkeyPatch, device: str
) -> None:
    pretended = Pretended(GPU, PROVIDERS[device])
    found = session(monkeypatch, pretended, device=device)({"x": np.float32([1.0, 2.0])})
    np.testing.assert_array_equal(found["y"], [2.0, 4.0])
    assert bool(pretended.bindings) == (device == "cuda")


def test_what_one_network_hands_to_another_stays_on_the_gpu(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pretended = Pretended(GPU, PROVIDERS["cuda"])
    network = session(monkeypatch, pretended, device="cuda")
    handed = network.on_device({"x": np.float32([1.0])})
    assert isinstance(handed["y"], OnGpu)
    again = network.on_device({"x": handed["y"]})
    assert pretended.bindings[-1].inputs["x"] is handed["y"]
    assert pretended.bindings[-1].outputs == {"y": "cuda"}
    np.testing.assert_array_equal(again["y"].numpy(), [4.0])
