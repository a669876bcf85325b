"""A depth network of one convolution: red says how deep a pixel is, green how sure that is."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from aquaflow.prior.folder import IMAGENET_MEAN, IMAGENET_STD, DepthCard

LOWEST = 0.1
"""Red, of 1, from which the network with a logarithm knows something."""


def write_network(
    path: Path,
    size: tuple[int | str, int | str] = ("height", "width"),
    gain: float = 1.0,
    offset: float = 0.0,
    logarithm: bool = False,
    views: bool = False,
    stride: int = 1,
) -> Path:
    """Outputs "depth", ``gain`` red + ``offset``, or the logarithm of red - LOWEST, and "sure",
    green; of pictures that are normalised as usual."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    weights = np.zeros((2, 3, 1, 1), np.float32)
    weights[0, 0], weights[1, 1] = gain * IMAGENET_STD[0], IMAGENET_STD[1]
    first = gain * IMAGENET_MEAN[0] + (-LOWEST if logarithm else offset)
    bias = np.float32([first, IMAGENET_MEAN[1]])
    known = [numpy_helper.from_array(weights, "weights"), numpy_helper.from_array(bias, "bias")]
    shape = [1, 1, 3, *size] if views else [1, 3, *size]
    nodes, picture = [], "image"
    if views:
        axis = numpy_helper.from_array(np.int64([1]), "axis")
        known.append(axis)
        nodes.append(helper.make_node("Squeeze", ["image", "axis"], ["single"]))
        picture = "single"
    nodes += [
        helper.make_node("Conv", [picture, "weights", "bias"], ["both"], strides=[stride, stride]),
        helper.make_node("Split", ["both"], ["raw", "sure"], axis=1, num_outputs=2),
        helper.make_node("Log" if logarithm else "Identity", ["raw"], ["depth"]),
    ]
    graph = helper.make_graph(
        nodes,
        "depth",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, shape)],
        [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, None)
            for name in ("depth", "sure")
        ],
        known,
    )
    opset = [helper.make_opsetid("", 18)]
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=10), path)
    return path


def card(**changes: object) -> DepthCard:
    """Of that network: depth in metres, 8 px."""
    stated = {"input": "image", "output": "depth", "multiple_px": 8, "measure": "depth"}
    return DepthCard.model_validate(stated | {"unit": "metres", "relative_error": 0.1} | changes)


def painted(
    red: np.ndarray,  # [H, W] in [0, 1]
    green: float = 0.5,
) -> np.ndarray:
    """[H, W, 3] a picture that the network reads."""
    channels = [red, np.full_like(red, green), np.zeros_like(red)]
    return np.round(255.0 * np.stack(channels, -1)).astype(np.uint8)
