"""How a map's restored colours are shown: the white balance that was chosen, and one tone.

Both are judged by the map itself, drawn from some of its views through the water and without it, so
that they can be chosen anew for a finished dive, whose map has no pictures. They are kept with the
map until it is optimised further.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.config.white_balance import DAYLIGHT, NEUTRAL
from aquaflow.mapping.restoration import mean_water, restored_own, was_restored
from aquaflow.mapping.scene import RenderedMap, Scene
from aquaflow.render.transfers import picture_out, water_out
from aquaflow.render.views import View, in_time
from aquaflow.water.daylight import daylight_at, type_named, types_like
from aquaflow.water.illuminant import (
    SCENE_ERROR,
    Illuminant,
    gain_to_grey,
    illuminant_of,
    methods_in,
)
from aquaflow.water.tone import ShownTone, tone_of
from aquaflow.water.white_balance import ChosenWhite, Recovered

if TYPE_CHECKING:
    from aquaflow.mapping.mapper import Mapper

Array = npt.NDArray[np.float64]

LOOKS = 20
"""Views, spread over the dive, that white balance and tone are judged by."""
LOOK_PIXELS = 4000
"""Of each of them, on a grid: mean lightness to a tenth of a unit."""
DOUBTFUL = 3.0
"""Sigmas between daylight as it is said to be and the scene's own estimate: 1.0 and 1.3 on two
synthetic dives lit so; 3.8 on one that is not, 4.4 on the reef clip, whose camera balanced itself,
and 3.5 on a hull that is red."""
CLIPPED = 0.97
"""Seen value from which a channel may be cut off, and then says nothing of the light's colour."""


@dataclass(frozen=True)
class Grey:
    """A place that is said to be grey."""

    name: str
    """``FRAME:X,Y``"""
    colour: Array
    """[3] RGB of the map there, restored in the camera's white balance."""
    z: float
    """Its range, map units."""
    pixels: int
    """That the colour is the mean of."""


def shown_tone(mapper: Mapper) -> ShownTone:
    """The tone of all restored pictures of the map; drawn and judged where it is not known yet, and
    the white balance of the map's settings with it. A map without water has none."""
    if not mapper.medium.active:
        return ShownTone()
    if mapper.tone is None or mapper.tone[0] != mapper.steps:
        choose(mapper, mapper.config.medium.white_balance)
    assert mapper.tone is not None
    return mapper.tone[1]


@torch.no_grad()
def choose(mapper: Mapper, choice: str | Grey) -> None:
    """Show the restored colours of a map in water in this white balance from now on: one of those
    that a configuration can name, or that in which a place is grey. In the camera's, where too
    little was restored to say what is neutral, or daylight is asked for and no depth known."""
    _set_white(mapper.scene, ChosenWhite())
    fitted = mapper.scene.balance is not None
    looks = _looks(mapper, find_light=fitted and choice == NEUTRAL)
    if isinstance(choice, Grey):
        _set_white(mapper.scene, _white_of(mapper, choice.name, _illuminant_of(choice), choice))
    elif (light := looks.light or _daylight(mapper, choice)) is not None:
        _set_white(mapper.scene, _white_of(mapper, choice, light))
    gain = np.ones(3) if mapper.scene.balance is None else mapper.scene.balance.chosen.gain
    mapper.tone = (mapper.steps, tone_of(looks.seen, looks.clear * gain))


def _set_white(scene: Scene, white: ChosenWhite) -> None:
    if scene.balance is not None:
        scene.balance = replace(scene.balance, chosen=white)


def _illuminant_of(grey: Grey) -> Illuminant:
    log = np.log(grey.colour)
    return Illuminant(log - log.mean(), np.zeros(3))


def _daylight(mapper: Mapper, choice: str) -> Illuminant | None:
    """What a choice of daylight says of the light, in the camera's white balance."""
    balance, depths = mapper.scene.balance, mapper.depths
    water = mean_water(mapper.scene, mapper.views)
    if not choice.startswith(DAYLIGHT) or balance is None or depths is None or water is None:
        return None
    _, _, named = choice.partition(":")
    sigma = balance.attenuation_sigma
    types = type_named(named) if named else types_like(water_out(water.beta_a), sigma)
    light = daylight_at(types, depths)
    log = light.log + np.log(balance.gain)
    return Illuminant(log - log.mean(), light.sigma)


@torch.no_grad()
def doubt_of_daylight(mapper: Mapper, choice: str) -> str | None:
    """A sentence where lamps light the scene, or the light that the restored scene itself shows is
    hardly that of the ``choice``, before it is chosen; None where it may be, or one of them is not
    known."""
    _set_white(mapper.scene, ChosenWhite())
    said = _daylight(mapper, choice)
    if said is not None and mapper.scene.lamp is not None:
        return f"lamps light the scene, and {choice} is not their light's colour; choose {NEUTRAL}"
    shown = None if said is None else _looks(mapper, find_light=True).light
    if said is None or shown is None:
        return None
    sigma = np.sqrt(said.sigma**2 + shown.sigma**2 + SCENE_ERROR**2)
    off = float((np.abs(said.log - shown.log) / sigma).max())
    if off <= DOUBTFUL:
        return None
    return (
        f"{choice} is {off:.1f} sigma from the light that the scene itself shows: the camera may "
        "have balanced itself, the water be of another type, or the ground coloured; compare with "
        f"{NEUTRAL}"
    )


def _white_of(
    mapper: Mapper, name: str, light: Illuminant, place: Grey | None = None
) -> ChosenWhite:
    """The gain that makes ``light`` grey, as far as the light at ``place``, or of what is nearest,
    allows."""
    balance, water = mapper.scene.balance, mean_water(mapper.scene, mapper.views)
    if balance is None or water is None:
        return ChosenWhite(name)
    mean = np.multiply(balance.mean, balance.gain)
    z, pixels = (balance.near_range, 1) if place is None else (place.z, place.pixels)
    noise = water_out(balance.noise_of_light(water, z, pixels))
    assumed = SCENE_ERROR if name == NEUTRAL else 0.0
    return ChosenWhite(name, *gain_to_grey(light, noise, mean, assumed))


# --------------------------------------------------------------------------------------------------
# What the map looks like from some of its views.


@dataclass(frozen=True)
class _Looks:
    seen: Array
    """[n, 3] colours through the water."""
    clear: Array
    """[n, 3] the same without it."""
    light: Illuminant | None
    """The colour of the light; None where it was not asked for, or too little is to be seen."""


def _looks(mapper: Mapper, find_light: bool) -> _Looks:
    spread = in_time(mapper.views)[:: max(1, len(mapper.views) // LOOKS)]
    samples = [(np.zeros((0, 3)), np.zeros((0, 3)))]
    said, weights = list[Array](), list[float]()
    for view in spread:
        shown = mapper.show(view)
        has_picture = view.has_pixels and view.image.size > 0
        if find_light or not has_picture:
            own = restored_own(mapper.scene, view, shown)
        if has_picture:
            samples.append(_in_picture(mapper.scene, view, shown))
        else:
            samples.append(seen_and_clear(view, shown, own))
        if find_light:
            picture, weight = _weigh(mapper.scene, view, shown, own)
            if (found := methods_in(picture, weight)) is not None:
                said.append(found)
                weights.append(float(weight.sum()))
    seen, clear = (np.concatenate(each) for each in zip(*samples, strict=True))
    return _Looks(seen, clear, illuminant_of(said, weights))


@torch.no_grad()
def seen_and_clear(view: View, shown: RenderedMap, own: Recovered) -> tuple[Array, Array]:
    """[n, 3] colours of what was restored, through the water and, ``own``, without it."""
    step = max(1, round((shown.alpha.numel() / LOOK_PIXELS) ** 0.5))
    grid = (slice(step // 2, None, step), slice(step // 2, None, step))
    judged = was_restored(view, shown, own)[grid]
    seen, clear = shown.image[grid][judged], own.picture[grid][judged]
    return picture_out(seen).astype(np.float64), picture_out(clear).astype(np.float64)


def _in_picture(scene: Scene, view: View, shown: RenderedMap) -> tuple[Array, Array]:
    """[n, 3] colours of what was restored of the view's picture, as it is and without water. The
    map lacks its finest detail, which restoration makes stronger, and so darker on the mean."""
    recovered = scene.recover(view, scene.evenly_lit(view), shown.z)
    return seen_and_clear(view, replace(shown, image=view.target()), recovered)


def _weigh(
    scene: Scene, view: View, shown: RenderedMap, own: Recovered
) -> tuple[npt.NDArray[np.floating], npt.NDArray[np.floating]]:
    """[H, W, 3] the map from the view without its water, and [H, W] how much each pixel says of the
    light: its confidence, less the further away it is than what is nearest."""
    usable = was_restored(view, shown, own)
    usable = usable & torch.isfinite(own.picture).all(dim=-1)
    usable = usable & (shown.image.amax(dim=-1) < CLIPPED)
    near = 0.0 if scene.balance is None else scene.balance.near_range
    weight = own.confidence * (near / shown.z.clamp_min(near)).square()
    weight = torch.where(usable, weight, 0.0)
    return picture_out(torch.where(usable[..., None], own.picture, 0.0)), picture_out(weight)
