"""A compact prior of one convolution, on disk in a moment: what a real export looks like."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from aquaflow.prior.folder import DECODER, ENCODER, PriorCard, sha256_of, write_card
from aquaflow.prior.runtime import INT8_ENCODER


def write_stub(
    folder: Path, height: int | str = "height", width: int | str = "width", int8: bool = False
) -> Path:
    """Encoder of one convolution; sizes are free unless given. ``int8``: beside it, its negative
    as the encoder in 8 bits, so that a test sees which of them runs."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(64, 3, 8, 8)).astype(np.float32)
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, height, width])
    cells = helper.make_tensor_value_info("Dc", TensorProto.FLOAT, [1, 64, "rows", "columns"])
    conv = helper.make_node("Conv", ["image", "weights"], ["Dc"], strides=[8, 8])
    files = {ENCODER: weights, DECODER: weights}
    if int8:
        files[INT8_ENCODER] = -weights
    for name, values in files.items():
        known = [numpy_helper.from_array(values, "weights")]
        graph = helper.make_graph([conv], "stub", [image], [cells], known)
        opset = [helper.make_opsetid("", 18)]
        onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=10), folder / name)
    card = PriorCard(
        name="compact",
        width=320,
        height=240,
        descriptor=24,
        metric=False,
        licence="Apache-2.0",
        opset=18,
        files={name: sha256_of(folder / name) for name in files},
        parity={"Dc": 0.0},
    )
    write_card(folder, card)
    return folder
