"""What a browser computes, without one: the functions in its shader's text, translated."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch

from aquaflow.survey.viewer import client
from aquaflow.survey.viewer.seen_water import SeenWater, water_of
from aquaflow.water.medium import WaterParameters
from aquaflow.water.mounting import Lamp
from aquaflow.water.tone import ShownTone

Array = npt.NDArray[np.float64]

BETA, B_INF, B = (0.5, 0.25, 0.2), (0.05, 0.3, 0.35), (0.45, 0.3, 0.25)
B_RES, D = (0.02, 0.03, 0.03), (1.0, 0.9, 0.8)
GAIN, TONE = (1.3, 0.9, 0.8), ShownTone(1.2, 2.0)
LAMP = Lamp(share=0.7, power=2.05, range=1.5)
RANGES = (0.05, 0.4, 1.5, 4.0, 9.0)
"""From nearer than the lamp's light still grows."""
J = np.array([0.2, 0.4, 0.3])


def shader_functions(text: str, uniforms: dict[str, Any]) -> dict[str, Any]:
    """Those of the shader that are made of float and vec3, as Python's."""
    code = ""
    for head, name, arguments, body in re.findall(
        r"^(vec3) (\w+)\(([\w ,]+)\) \{\n(.*?)^\}", text, re.MULTILINE | re.DOTALL
    ):
        if "uvec" in body + arguments:
            continue
        names = ", ".join(part.split()[-1] for part in arguments.split(","))
        code += f"def {name}({names}):\n"
        for line in body.splitlines():
            plain = re.sub(rf"^ *(float|{head}) ", "", line.split("//")[0]).strip().rstrip(";")
            code += "    " + re.sub(r", (\w+ = )", r"; \1", plain) + "\n"
    known: dict[str, Any] = {
        "min": np.minimum, "max": np.maximum, "exp": np.exp, "pow": np.power,
        "vec3": lambda one: np.full(3, one), **uniforms,
    }  # fmt: skip
    exec(code, known)  # the repository's own text
    return known


class Vector(np.ndarray[Any, Any]):
    """With GLSL's names of the parts."""

    x = property(lambda self: self[0])
    y = property(lambda self: self[1])
    z = property(lambda self: self[2])


def as_glsl(text: str) -> str:
    """Functions of WGSL that are made of float and vec3 in the other shader's words."""
    renamed = (
        *(("side.", ""), ("vec3f", "vec3"), ("f32", "float"), ("B_inf", "Binf"), ("B_res", "Bres")),
        *(("shown_compression", "shownCompression"), ("through_water", "throughWater")),
    )
    for word, other in renamed:
        text = text.replace(word, other)
    text = re.sub(r"(\w+): (vec3|float)\b", r"\2 \1", text)
    text = re.sub(r"^fn (\w+\(.*\)) -> vec3 ", r"vec3 \1 ", text, flags=re.MULTILINE)
    return text.replace("; let ", ", ").replace("let ", "vec3 ")


SHADERS = {"shaders.js": str, "splats.wgsl": as_glsl}
"""Of WebGL and of WebGPU."""


@pytest.fixture(params=SHADERS)
def shader(request: pytest.FixtureRequest) -> str:
    text = Path(client.__file__).with_name(request.param).read_text()
    return str(SHADERS[request.param](text))


def drawn(text: str, clear: Array, z: float, seen: SeenWater, water: float = 1.0) -> Array:
    """The colour that the shader gives a Gaussian of this colour at range z."""
    part = {
        "beta": seen.beta, "Binf": seen.B_inf, "b": seen.b, "Bres": seen.B_res, "d": seen.d,
        "gain": seen.gain, "white": seen.white, "lamp": seen.lamp,
    }  # fmt: skip
    uniforms: dict[str, Any] = {name: np.array(row).view(Vector) for name, row in part.items()}
    uniforms |= {"water": water, "through": 20.0, "compression": seen.compression}
    functions = shader_functions(text, uniforms | {"shownCompression": seen.shown_compression})
    return np.asarray(functions["throughWater"](clear, z))


def seen_by(lamp: Lamp | None) -> SeenWater:
    stated = lamp and {"share": lamp.share, "power": lamp.power, "range": lamp.range}
    found = water_of(
        {
            "active": True, "attenuation_per_unit": BETA, "lamp": stated,
            "backscatter": {"B_inf": B_INF, "b": B, "B_res": B_RES, "d": D},
            "restored": {
                "gain": GAIN, "exposure": TONE.exposure,
                "highlight_compression": TONE.compression, "white_balance": {},
            },
            "map_ply_reference_range": 2.0,
        }
    )  # fmt: skip
    assert found is not None
    return found


@pytest.mark.parametrize("lamp", [None, LAMP])
def test_through_the_water_a_browser_shows_what_the_renderer_does(
    shader: str, lamp: Lamp | None
) -> None:
    of = [torch.tensor(each, dtype=torch.float64) for each in (BETA, B_INF, B, B_RES, D)]
    water = WaterParameters(*of, lamp)
    clear = np.asarray(TONE.of(np.array(GAIN) * J))
    for z in RANGES:
        at = torch.tensor([z], dtype=torch.float64)
        rendered = torch.tensor(J) * water.transmission(at)[0] + water.backscatter(at)[0]
        # The renderer's exponents end at MAX_OPTICAL_DEPTH.
        np.testing.assert_allclose(
            drawn(shader, clear, z, seen_by(lamp)), rendered.numpy(), atol=1e-5
        )


@pytest.mark.parametrize("lamp", [None, LAMP])
def test_without_water_a_browser_shows_the_colours_that_it_got(
    shader: str, lamp: Lamp | None
) -> None:
    clear = np.asarray(TONE.of(np.array(GAIN) * J))
    for z in RANGES:
        np.testing.assert_allclose(
            drawn(shader, clear, z, seen_by(lamp), water=0.0), clear, rtol=1e-9
        )
