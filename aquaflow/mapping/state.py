"""Serialisation of a map into facts and arrays; a restored map renders bit for bit the same.

What there is to see: Gaussians and whose they are, water, shading, exposures and light, the
decoder with its features and groups, and the posed cameras. With the optimiser's part, the map goes
on being optimised as if it had never been away, once its views have their pictures again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from aquaflow.base.errors import DamagedError
from aquaflow.base.errors.failures import Failures
from aquaflow.config import MappingConfig
from aquaflow.config.stage import without_old_keys
from aquaflow.geometry.arrays import (
    Arrays,
    add_prefix,
    of_camera,
    of_sim3,
    to_camera,
    to_sim3,
    under,
)
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.neural.neural import NeuralGaussians
from aquaflow.mapping.restoration import RESTORED, seen_and_restored
from aquaflow.mapping.tiles import TileFiles
from aquaflow.render.adam import SelectiveAdam
from aquaflow.render.contract import CPU, Renderer, radiance
from aquaflow.render.dense_adam import STEP, DenseAdam
from aquaflow.render.transfers import checkpoint_in, checkpoint_out, map_out
from aquaflow.render.views import View
from aquaflow.water.exposure import log_gains_of, set_log_gain
from aquaflow.water.mounting import Lamp
from aquaflow.water.sightings import SOLID
from aquaflow.water.sunlight import COLUMNS
from aquaflow.water.tone import ShownTone, tone_of
from aquaflow.water.white_balance import ChosenWhite, WhiteBalance

Facts = dict[str, Any]

NO_PIXELS = np.zeros((0, 0, 3), np.uint8)
"""A view's picture is no part of the map."""
VIEWS = "views."
"""What the names of the views' arrays begin with."""
GROUPS = ("group", "slot", "table", "fill", "voxel", "features")
"""Tables of the voxel groups, in the order of their names in the file."""


def serialise(mapper: Mapper, optimiser: bool = False) -> tuple[Facts, Arrays]:
    """Facts for JSON, and arrays, which are copies; ``optimiser``: its state too."""
    scene, cameras = mapper.scene, list(dict.fromkeys(view.camera for view in mapper.views))
    facts: Facts = {
        "config": mapper.config.model_dump(mode="json"),
        "medium_active": mapper.medium.active,
        "exposes": scene.exposes,
        "sunlight_columns": scene.sunlight.columns,
        "water_evidence": scene.water_evidence,
        "beta_a_sigma": scene.beta_a_sigma,
        "lamp": None if scene.lamp is None else asdict(scene.lamp),
        **_white_facts(scene.balance),
        "tone": None if mapper.tone is None else [mapper.tone[0], asdict(mapper.tone[1])],
        "range_variance": scene.range_variance,
        "lightness_over_range": scene.lightness_over_range,
        "decoder": mapper.neural is not None,
        "optimiser": optimiser,
        "steps": mapper.steps,
        "undone": mapper.undone,
        "unlimited": mapper.unlimited,
        "cameras": [of_camera(camera) for camera in cameras],
    }
    arrays = _prefix("gaussians", mapper.gaussians.parameters)
    arrays["keyframes"] = checkpoint_out(mapper.gaussians.keyframes)
    arrays["shading"] = scene.shading.copy()
    arrays |= _prefix("medium", mapper.medium.state_dict())
    arrays |= _views(mapper.views, cameras)
    if mapper.neural is not None:
        arrays |= _decoder(mapper.neural)
    if optimiser:
        arrays |= add_prefix("tiles", mapper.tiles.serialise())
        facts["next_water_fit"] = mapper.water_fitting.next_fit
        facts["rates"] = {name: adam.learning_rates for name, adam in _adams(mapper).items()}
        facts["rates"] |= {name: each.rates[0] for name, each in _dense(mapper).items()}
        arrays |= _optimisers(mapper)
    return facts, arrays


def _white_facts(balance: WhiteBalance | None) -> Facts:
    """The camera's white balance as any AquaFlow reads it, and what was chosen on top."""
    if balance is None:
        return {"white_balance": None}
    camera = asdict(balance)
    return {"chosen_white": camera.pop("chosen"), "white_balance": camera}


def deserialise(
    facts: Facts,
    arrays: Mapping[str, Any],
    renderer: Renderer,
    failures: Failures | None = None,
    tiles: TileFiles | None = None,
) -> Mapper:
    """The serialised map; its views have poses, exposures and light, but no pixels.

    What its fits and steps raise is counted in ``failures``; what waited does so in ``tiles``.

    Raises:
        KeyError, ValueError, TypeError, RuntimeError, AquaFlowError: these are no map's.
    """
    config = without_old_keys({"mapping": facts["config"]}, "the map")["mapping"]
    mapper = Mapper(MappingConfig.model_validate(config), renderer, 0, failures, tiles)
    scene, gaussians, device = mapper.scene, mapper.gaussians, mapper.device
    for name, width in gaussians.WIDTHS.items():
        values = checkpoint_in(arrays[f"gaussians.{name}"], device)
        gaussians.parameters[name] = values.reshape(-1, width)
    gaussians.keyframes = checkpoint_in(arrays["keyframes"], device)
    width = gaussians.local_features.shape[1]  # a decoder, if there is one, brings its own
    gaussians.local_features = torch.zeros(len(gaussians.keyframes), width, device=device)
    if any(len(tensor) != len(gaussians) for tensor in gaussians.parameters.values()):
        raise DamagedError("its Gaussians differ in number")
    scene.shading = np.array(arrays["shading"])
    # Maps written before 2026-11-23 know no mean over the orientations.
    medium = mapper.medium.state_dict() | _under("medium", arrays, device)
    mapper.medium.load_state_dict(medium)
    mapper.medium.active, scene.exposes = bool(facts["medium_active"]), bool(facts["exposes"])
    coarse = COLUMNS[0] * facts.get("sunlight_plays", 0)  # in maps written before 2026-11-27
    scene.sunlight.columns = int(facts.get("sunlight_columns", coarse))
    scene.water_evidence, scene.beta_a_sigma = facts["water_evidence"], facts["beta_a_sigma"]
    if facts.get("lamp") is not None:  # not in maps written before 2026-11-26
        scene.lamp = Lamp.of(facts["lamp"])
    if "gain" in (facts.get("white_balance") or {}):  # not in maps written before 2026-11-22
        chosen = ChosenWhite(**facts.get("chosen_white", {}))  # not before 2026-11-27
        scene.balance = WhiteBalance(**facts["white_balance"], chosen=chosen)
    if facts.get("tone") is not None:
        mapper.tone = (int(facts["tone"][0]), ShownTone(**facts["tone"][1]))
    for name in ("range_variance", "lightness_over_range"):  # the latter not before 2026-11-27
        if facts.get(name) is not None:
            raw, restored = facts[name]
            setattr(scene, name, (float(raw), float(restored)))
    mapper.optimiser.steps, mapper.optimiser.undone = int(facts["steps"]), int(facts["undone"])
    mapper.unlimited = int(facts.get("unlimited", 0))
    mapper.views = deserialise_views(facts, arrays, device)
    mapper.optimiser.adam.extend(len(gaussians))
    mapper.optimiser.adam.bind(gaussians.parameters)
    if not facts["decoder"]:
        scene.neural = None  # baked, though the config began with one
    elif mapper.neural is not None:
        _read_decoder(mapper.neural, arrays)
    if facts["optimiser"]:
        mapper.water_fitting.next_fit = int(facts["next_water_fit"])
        _read_optimisers(mapper, arrays, facts["rates"])
        mapper.resume_tiles(under("tiles", arrays))
    return mapper


# --- views ----------------------------------------------------------------------------------------


OF_SOME_VIEWS = ("light", "explained")
"""Tensors that a view has, or None."""


def _views(views: Sequence[View], cameras: list[CameraModel]) -> Arrays:
    numbers = [
        (v.frame_index, v.keyframe, v.robust, v.looks, v.moments[2], cameras.index(v.camera))
        for v in views
    ]
    moments = [v.moments[:2] for v in views]
    arrays = {
        "views.numbers": np.array(numbers, np.int64).reshape(-1, 6),
        "views.poses": of_sim3([view.T_wc for view in views]),
        "views.log_gains": log_gains_of(views) if views else np.zeros((0, 3)),
        "views.moments": np.array(moments, np.float64).reshape(-1, 12),
    }
    for name in OF_SOME_VIEWS:
        arrays |= _joined(f"views.{name}", [getattr(view, name) for view in views])
    return arrays


def _joined(
    name: str,
    values: Sequence[Tensor | None],  # [...] each
) -> Arrays:
    """Tensors of as many axes in three arrays: as an array each, those of an hour's views would
    take a checkpoint's reader ten times as long as all the rest."""
    known = {i: value for i, value in enumerate(values) if value is not None}
    if not known:
        return {}
    return {
        f"{name}.of": np.array(list(known), np.int64),
        f"{name}.shapes": np.array([value.shape for value in known.values()], np.int64),
        f"{name}.values": checkpoint_out(torch.cat([value.ravel() for value in known.values()])),
    }


def _separate(name: str, arrays: Mapping[str, Any]) -> dict[int, Any]:
    """What :func:`_joined` joined, by place."""
    if f"{name}.of" not in arrays:
        return {}
    shapes, values = arrays[f"{name}.shapes"], arrays[f"{name}.values"]
    ends = np.cumsum(shapes.prod(axis=1))
    if len(values) != ends[-1]:
        raise DamagedError("its views have other shapes than their light")
    parts = np.split(values, ends[:-1])
    places = arrays[f"{name}.of"].tolist()
    return {i: part.reshape(shape) for i, part, shape in zip(places, parts, shapes, strict=True)}


def deserialise_views(
    facts: Facts, arrays: Mapping[str, Any], device: torch.device = CPU
) -> list[View]:
    """The views of a serialised map; of ``arrays`` those whose names begin with VIEWS are enough.

    Raises:
        KeyError, ValueError, TypeError, IndexError: these are no map's.
    """
    if len(facts["cameras"]) > len(arrays["views.numbers"]):
        raise DamagedError("it has more cameras than views")
    cameras = [to_camera(values) for values in facts["cameras"]]
    views = []
    rows = (arrays[f"views.{name}"] for name in ("numbers", "poses", "log_gains", "moments"))
    of_some = {name: _separate(f"views.{name}", arrays) for name in OF_SOME_VIEWS}
    for i, (numbers, pose, log_gain, moments) in enumerate(zip(*rows, strict=True)):
        index, keyframe, robust, looks, count, camera = numbers.tolist()
        T_wc, of_outliers = to_sim3(pose), bool(robust)
        view = View(index, NO_PIXELS, cameras[camera], T_wc, keyframe, of_outliers, device=device)
        set_log_gain(view, log_gain.copy())
        view.looks = looks
        view.moments = (moments[:6].copy(), moments[6:].copy(), count)
        for name, known in of_some.items():
            value = known.get(i, arrays.get(f"views.{name}{i}"))  # the latter before 2026-11-29
            if value is not None:
                setattr(view, name, checkpoint_in(value, device))
        views.append(view)
    return views


# --- decoder --------------------------------------------------------------------------------------


def _decoder(neural: NeuralGaussians) -> Arrays:
    neural.settle()
    groups = neural.groups
    arrays = _prefix("decoder", neural.decoder.state_dict())
    arrays |= _prefix("groups", {name: getattr(groups, name) for name in GROUPS})
    arrays["voxel_size"] = np.array(groups.size)
    arrays["groups.order"] = checkpoint_out(groups.order())
    arrays["local"] = checkpoint_out(neural.gaussians.local_features)
    return arrays


def _read_decoder(neural: NeuralGaussians, arrays: Mapping[str, Any]) -> None:
    device = neural.device
    neural.decoder.load_state_dict(_under("decoder", arrays, device))
    groups = {name: checkpoint_in(arrays[f"groups.{name}"], device) for name in (*GROUPS, "order")}
    neural.groups.restore(**groups)
    if "voxel_size" in arrays:  # not in maps written before 2026-11-23
        neural.groups.size = float(arrays["voxel_size"])
    neural.restore(checkpoint_in(arrays["local"], device))


# --- optimisers -----------------------------------------------------------------------------------


def _adams(mapper: Mapper) -> dict[str, SelectiveAdam]:
    adams = {"adam": mapper.optimiser.adam}
    if mapper.neural is not None:
        features = mapper.neural.optimisers
        adams |= {"adam_local": features.local, "adam_shared": features.shared}
    return adams


def _dense(mapper: Mapper) -> dict[str, DenseAdam]:
    optimisers = {"adam_medium": mapper.optimiser.medium_adam}
    if mapper.neural is not None:
        optimisers["adam_decoder"] = mapper.neural.optimisers.weights
    return optimisers


def _optimisers(mapper: Mapper) -> Arrays:
    arrays: Arrays = {"random": mapper._random.get_state().numpy().copy()}
    for name, adam in _adams(mapper).items():
        arrays[f"{name}.steps"] = checkpoint_out(adam.steps)
        arrays |= _prefix(f"{name}.first", adam.first_moments)
        arrays |= _prefix(f"{name}.second", adam.second_moments)
    for name, optimiser in _dense(mapper).items():
        for i, state in optimiser.state.items():
            arrays |= _prefix(f"{name}.{i}", state)
    return arrays


def _read_optimisers(mapper: Mapper, arrays: Mapping[str, Any], rates: Facts) -> None:
    mapper._random.set_state(torch.from_numpy(np.array(arrays["random"])))
    device = mapper.device
    for name, adam in _adams(mapper).items():
        adam.steps = checkpoint_in(arrays[f"{name}.steps"], device)
        adam.first_moments.update(_under(f"{name}.first", arrays, device))
        adam.second_moments.update(_under(f"{name}.second", arrays, device))
        adam.learning_rates.update(rates[name])
        adam.bind({})
    for name, optimiser in _dense(mapper).items():
        for i in range(len(optimiser.tensors)):
            state = under(f"{name}.{i}", arrays)
            if state:
                optimiser.state[i] = {
                    part: checkpoint_in(array, CPU if part == STEP else device)
                    for part, array in state.items()
                }
        optimiser.rates[0] = float(rates[name])


# --- arrays ---------------------------------------------------------------------------------------


def _prefix(
    prefix: str,
    tensors: Mapping[str, Tensor],  # of any shape
) -> Arrays:
    """Copies, as arrays."""
    return add_prefix(prefix, {name: checkpoint_out(tensor) for name, tensor in tensors.items()})


def _under(prefix: str, arrays: Mapping[str, Any], device: torch.device) -> dict[str, Tensor]:
    """What :func:`_prefix` put there."""
    return {name: checkpoint_in(array, device) for name, array in under(prefix, arrays).items()}


# --------------------------------------------------------------------------------------------------
# A copy of what is shown of a map, which goes on being mapped meanwhile.


MOST_JUDGED = 20_000
"""Gaussians that the tone of a copy is judged by: some milliseconds."""


@dataclass(frozen=True)
class MapCopy:
    """Copies of the shown parts of a map, for any thread."""

    parameters: dict[str, npt.NDArray[np.float32]]
    steps: npt.NDArray[np.int32]
    """[N] optimiser steps of each Gaussian."""
    clear: npt.NDArray[np.float32]
    """[N, 3] without water, as shown in ``tone``."""
    water: npt.NDArray[np.float32] | None
    """[6, 3] beta, B_inf, b, B_res, d as the last camera sees it, and the gain of ``clear``."""
    lamp: Lamp | None
    """Light from beside the camera."""
    tone: ShownTone
    """Judged by the Gaussians: of a map that grows, no view stands for all."""
    views: list[Sim3]
    """T_wc of the mapped views; the last one is the newest."""


@torch.no_grad()
def copy_map(mapper: Mapper) -> MapCopy:
    """In the mapping thread: a copy; a tenth of a second for 150,000 Gaussians."""
    tensors = mapper.gaussians.parameters
    plain = {name: map_out(tensor) for name, tensor in tensors.items()}
    clear, tone = _apply_tone(mapper, tensors)
    view = mapper.views[-1]
    water = mapper.scene.water(view)
    rows = None
    if water is not None:
        rows = map_out(torch.cat([water.stack(), mapper.scene.white_gain()[None]]))
    steps = map_out(mapper.optimiser.adam.steps)
    poses = [each.T_wc for each in mapper.views]
    return MapCopy(plain, steps, clear, rows, mapper.scene.lamp, tone, poses)


def _apply_tone(
    mapper: Mapper,
    tensors: Mapping[str, Tensor],  # of a GaussianMap
) -> tuple[npt.NDArray[np.float32], ShownTone]:
    """[N, 3] colours without water as they are shown, and their tone."""
    J = radiance(tensors["raw_colours"])
    seen, recovered = seen_and_restored(mapper.scene, J, mapper.views)
    clear = map_out(recovered.picture)
    if not mapper.medium.active:
        return clear, ShownTone()
    solid = torch.sigmoid(tensors["opacity_logits"][:, 0]) > SOLID
    judged = np.flatnonzero(map_out(solid & (recovered.confidence > RESTORED)))
    judged = judged[:: max(1, len(judged) // MOST_JUDGED)]
    tone = tone_of(map_out(seen)[judged].astype(np.float64), clear[judged].astype(np.float64))
    return tone.of(clear).astype(np.float32), tone
