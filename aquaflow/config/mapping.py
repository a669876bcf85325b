"""Settings of the map: water, insertion, losses, optimiser (paper, Sec. 3.3 and 3.4)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from aquaflow.config.stage import Lab, StageConfig
from aquaflow.config.white_balance import CAMERA, require_name


class WaterPriorsConfig(StageConfig):
    """Priors of the water fit on scenes and waters; all weak, none in the paper.

    Measured on twelve fits of six known waters (mean error of beta_a), and on Curasao and IUI3
    (restored views against the raw ones): none 8.2 %, 1.1 and 2.9 dB; dark channel 7.6 %, 1.1 and
    3.1 dB; with it saturation 7.6 %, 1.1 and 3.4 dB. A grey scene (8.3 %, 1.1 and 2.9 dB) and white
    backscatter (10.5 %, 1.1 and 2.8 dB) lost everywhere and went.
    """

    dark_channel: bool = Field(True, description="shadows are nearly black (He et al. 2011)")
    saturation: bool = Field(True, description="few points are brighter than the camera's white")
    regions: bool = Field(True, description="near and far have the same colours on the whole")


class MediumConfig(StageConfig):
    """The water (paper, Sec. 3.3.2)."""

    enabled: bool = Field(True, description="False: the map is what the camera saw, water included")
    directional: Lab[bool] = Field(
        False,
        description="attenuation by the camera's orientation (the paper); False: isotropic",
    )
    directional_rate: Lab[float] = Field(
        1e-4, gt=0, description="Adam rate of MLP_a, where attenuation is directional"
    )
    width: Lab[int] = Field(
        32, ge=4, description="hidden units of MLP_a; paper silent, 32 cost nothing"
    )
    rate: Lab[float] = Field(
        1e-5,
        gt=0,
        description="Adam rate of all medium parameters but MLP_a's; beta_a of four known waters "
        "is 14 % wrong at 5e-4, 7 % at 1e-4, 6 % at 1e-6, and no picture worse: it drifts off the "
        "fit",
    )
    first_fit_views: Lab[int] = Field(
        12,
        ge=2,
        description="views after which water is first fitted to observations; then at every "
        "doubling, and before refining",
    )
    fit: Lab[bool] = Field(
        True, description="False: the water starts from the values below, no fit"
    )
    off_when_clear: Lab[bool] = Field(
        True, description="False: stays on even where the observations show no water"
    )
    shading: Lab[bool] = Field(True, description="False: the fit knows no lamp or lens fall-off")
    exposure: Lab[bool] = Field(
        True, description="False: light and exposure are held to be the same in all views"
    )
    uneven: Lab[bool] = Field(
        True, description="False: backscatter is held to be as bright all over the picture"
    )
    fit_views: Lab[int] = Field(
        20,
        ge=4,
        description="views that a fit looks at: spread over the dive, or in groups that see the "
        "same ground, where those do not",
    )
    priors: Lab[WaterPriorsConfig] = WaterPriorsConfig()
    open_water: Literal["kept", "removed", "black"] = Field(
        "black",
        description="what open water is in restored pictures: as the camera saw it, transparent, "
        "or black",
    )
    white_balance: Annotated[str, AfterValidator(require_name)] = Field(
        CAMERA,
        description="of restored pictures: camera (as it saw what was nearest), neutral (the light "
        "of the scene made grey), daylight (that at the dive's depth in its water made grey), or "
        "daylight:TYPE (in water of Jerlov's TYPE); exports of a dive can have another",
    )
    initial_attenuation: Lab[float] = Field(
        0.1, gt=0, description="1 / map unit; the median range of the first keyframe is 1 unit"
    )
    initial_B_inf: Lab[float] = Field(0.3, gt=0, lt=1, description="backscatter at infinity")
    initial_B_res: Lab[float] = Field(0.01, gt=0, lt=1, description="residual backscatter close by")
    initial_residual_decay: Lab[float] = Field(1.0, gt=0, description="1 / map unit")


class SunlightConfig(StageConfig):
    """Light that waves focus on the ground, view by view (not in the paper; see sunlight.py)."""

    enabled: bool = Field(
        True,
        description="False: all views are held to be lit alike; 4.4 dB worse on the reef clip, "
        "0.4 on Curasao, no different where no sun plays",
    )


class InsertionConfig(StageConfig):
    """Where new Gaussians go (paper, Sec. 3.3.3)."""

    medium_reduced: Lab[bool] = Field(
        True, description="False: structure and colours of new Gaussians from the raw picture"
    )
    sigma_px: Lab[float] = Field(1.0, gt=0, description="sigma of the Laplacian of Gaussian")
    norm: Lab[Literal["l1", "l2"]] = Field(
        "l1", description="of the Laplacian's response over the three colours; l2: the paper"
    )
    gain: Lab[float] = Field(
        3.0, gt=0, description="of the response, before it is cut off at 1; the paper: none, 1"
    )
    averaged: Lab[bool] = Field(
        True,
        description="the response is averaged over the operator's own width, so that both sides of "
        "an edge count and not the zero crossing on it; False: pixel by pixel (the paper)",
    )
    tau_a: Lab[float] = Field(
        0.02,
        ge=0,
        le=1,
        description="P_a above which a pixel may get a Gaussian; the paper's 1.0 never fires "
        "(docs/paper.md#tau-a)",
    )
    selection: Lab[Literal["random", "threshold"]] = Field(
        "random",
        description="random: pixels are drawn with probability P_a times density; threshold (the "
        "paper): every pixel with P_a above tau_a gets one, and density has no say in which",
    )
    colour_range: Lab[Literal["tracked", "rendered"]] = Field(
        "tracked",
        description="range over which the water is taken out of the picture: as tracked, and the "
        "map's where nothing is; rendered (the paper): the map's, and as tracked where the map is "
        "bare. Gaussians are placed at the first in both cases",
    )
    density: float = Field(
        5.0,
        gt=0,
        le=100,
        description="Gaussians per pixel for each unit of structure in an empty map, at most one "
        "in a pixel; falls to 1 as the map fills (notes/2026-11-mapping.md#density-with-room)",
    )
    bare_probability: Lab[float] = Field(
        0.06, ge=0, le=1, description="least P_a where the map does not cover the picture"
    )
    agreement: Lab[float] = Field(
        0.1, gt=0, description="relative range difference up to which map and prior agree"
    )
    recycle: Lab[float] = Field(
        0.1,
        ge=0,
        lt=1,
        description="share of a map at its hard cap that new Gaussians may replace, each time",
    )
    opacity: Lab[float] = Field(0.5, gt=0, lt=1, description="of a new Gaussian at full confidence")


class LossConfig(StageConfig):
    """Weights of the objective (paper, Sec. 3.4 and Implementation Details)."""

    ssim: float = Field(0.2, ge=0, le=1, description="lambda_ssim; paper: 0.2")
    depth: float = Field(0.01, ge=0, description="lambda_d; paper: 0.01")
    scale: float = Field(0.01, ge=0, description="lambda_s; paper: 0.01")
    tau_e: float = Field(0.2, gt=0, description="residual masked on common frames (ARTDECO: 0.2)")


class OptimiserConfig(StageConfig):
    """Adam rates and the number of steps."""

    betas: Lab[tuple[float, float]] = Field(
        (0.9, 0.95),
        description="Adam's decay rates; the second at 0.99 is 0.12 dB worse on Curasao, 0.09 on a "
        "synthetic reef, 0.02 on the reef clip, at 0.999 another 0.35 on Curasao",
    )
    means: Lab[float] = Field(8e-4, gt=0, description="map units per step; 4e-4 is 0.15 dB worse")
    means_final: Lab[float] = Field(
        0.1, gt=0, le=1, description="factor reached at the end of refining"
    )
    settle_share: Lab[float] = Field(
        0.3, ge=0, le=1, description="of refining, its end, in which every rate falls to "
        "settle_final: reef clip after 375 steps 29.30 instead of 29.07 dB",
    )  # fmt: skip
    settle_final: Lab[float] = Field(0.1, gt=0, le=1, description="factor of every rate at the end")
    quats: Lab[float] = Field(4e-3, gt=0)
    log_scales: Lab[float] = Field(
        0.016,
        gt=0,
        description="with half of it and of quats 0.4 to 0.5 dB worse on synthetic dives, and all "
        "rates falling by ten while refining 0.8 to 1.1: steps are too few to settle",
    )
    opacity_logits: Lab[float] = Field(0.04, gt=0)
    raw_colours: Lab[float] = Field(6e-3, gt=0)
    poses: Lab[float] = Field(1e-4, ge=0, description="rad and map units; ARTDECO: 1e-4; 0: held")
    steps_keyframe: Lab[int] = Field(20, ge=0, description="steps after a keyframe (ARTDECO: 20)")
    steps_mapping: Lab[int] = Field(
        20, ge=0, description="steps after a mapping frame (ARTDECO: 20)"
    )
    steps_common: Lab[int] = Field(2, ge=0, description="steps after a common frame (ARTDECO: 10)")
    refine_steps: int = Field(
        800,
        ge=0,
        description="steps after the last frame, for every max_gaussians of the map "
        "(notes/2026-11-mapping.md#refining)",
    )
    refine_seconds: float | None = Field(
        None,
        gt=0,
        description="s; limit of refining all maps together; makes runs differ from each other",
    )
    noise_floor: Lab[float] = Field(
        0.006,
        ge=0,
        description="mean error of a tile, of full scale, below which steps leave it out; sensor "
        "noise and 8 bits make 0.004; 0: no tile is left out",
    )
    skip_explained: Lab[bool] = Field(
        True, description="False: a step whose view has no tile left to draw is taken all the same"
    )
    full_look_every: Lab[int] = Field(
        4, ge=1, description="looks at a view, of which one is at all"
    )
    prune_every: Lab[int] = Field(200, ge=1)
    prune_opacity: Lab[float] = Field(
        0.02, gt=0, lt=1, description="opacity that is not worth keeping"
    )
    heldout_steps: Lab[int] = Field(
        8, ge=0, description="Gauss-Newton steps of a held-out view's pose at most, map frozen"
    )


class VoxelConfig(StageConfig):
    """Groups of neighbouring Gaussians (paper, Sec. 3.3.1)."""

    size: float = Field(
        0.05,
        gt=0,
        description="map units (1 is the first keyframe's median range); paper: 0.2 m, which is "
        "this at a range of 4 m; measured: 13 to 23 Gaussians a group on three dives",
    )
    size_m: float | None = Field(
        None,
        gt=0,
        description="m, in place of size as soon as the map's unit is known in metres; paper: 0.2",
    )
    capacity: int = Field(32, ge=1, description="Gaussians a group; paper: 32")


class DecoderConfig(StageConfig):
    """Rotation, scale and colour decoded from features and observation (paper, Sec. 3.3.1).

    Measured on a CPU, compiled kernel and all: after as many steps 0.2 dB better on the reef clip,
    0.0 on Curasao, 1.2 on a synthetic reef; but a step costs 1.2 to 1.9 times as much. After as
    much time it is 0.0 to 0.2 dB worse on the reef, 0.6 on Curasao, 0.3 on the synthetic reef:
    hence off.
    """

    enabled: bool = Field(False, description="False: every Gaussian is explicit")
    optimise_initial: bool = Field(
        True,
        description="False: what the residuals are added to stays as inserted (the paper); "
        "0.7 dB worse on the reef clip",
    )
    views_per_trunk: int = Field(
        4,
        ge=1,
        description="steps, of one view each, that share one pass over the groups; with 16 the "
        "features learn too rarely (0.2 dB), 8 is not measurably faster than 4; one step where the "
        "observation enters before the attention",
    )
    visible_groups: bool = Field(True, description="False: the pass takes all groups of the map")
    variant: Literal["lgpd", "mlp"] = Field(
        "lgpd", description="mlp: as many weights without attention (the paper's w/o LGPD)"
    )
    distance: bool = Field(True, description="False: the decoder does not get the distance")
    observation: Literal["after_attention", "before_attention"] = Field(
        "after_attention",
        description="where direction and distance enter; before_attention (the paper): in the "
        "tokens, with a pass over the groups for every view",
    )
    width: int = Field(32, ge=4, multiple_of=4, description="token width; paper silent")
    local_width: int = Field(16, ge=1, description="feature of a Gaussian (ARTDECO: 16)")
    global_width: int = Field(16, ge=1, description="feature of a group (ARTDECO: 16)")
    max_turn: float = Field(
        0.5, gt=0, description="largest component of the residual quaternion (1, u): 2 atan |u|"
    )
    max_log_scale: float = Field(1.0, gt=0, description="largest log-scale residual: factor e")
    max_colour: float = Field(0.5, gt=0, description="largest residual of a raw colour")
    rate: float = Field(4e-3, gt=0, description="Adam rate of the weights (ARTDECO: 4e-3)")
    voxels: VoxelConfig = VoxelConfig()


BYTES_PER_GAUSSIAN = 600
"""What one takes of a process on a CPU at its peak: 180 in tables (itself, its keyframe, Adam's
moments), the rest while tables grow and steps are taken (notes/2026-11-mapping.md#budget)."""
UNITS = {"MB": 1e6, "GB": 1e9}
_MEMORY = re.compile(r"(\d+(?:\.\d+)?) ?(MB|GB)")


def gaussians_in(value: object) -> object:
    """As many Gaussians as the memory holds that a text such as ``200 MB`` names; a number as it
    is.

    Raises:
        ValueError: the text names none.
    """
    if not isinstance(value, str) or value.strip().isdigit():
        return value
    match = _MEMORY.fullmatch(value.strip())
    if match is None:
        raise ValueError(
            f"{value[:40]!r} is no number of Gaussians and no memory, such as 200 MB or 1.5 GB"
        )
    return int(float(match[1]) * UNITS[match[2]] / BYTES_PER_GAUSSIAN)


class MappingConfig(StageConfig):
    """The map (paper, Sec. 3.3 and 3.4)."""

    enabled: bool = Field(True, description="False: trajectory only")
    renderer: Literal["auto", "cpu", "tiles", "gsplat", "wgpu"] = "auto"
    max_gaussians: Annotated[int, BeforeValidator(gaussians_in)] = Field(
        150_000,
        ge=1000,
        description="of a sub-map in memory, or the memory that they may take, as 200 MB; those of "
        "ground that is far from what is seen wait in files meanwhile (on a CPU, without a "
        "decoder), else those of least weight make room",
    )
    resolution_mm: float | None = Field(
        None,
        gt=0,
        description="mm on the ground between Gaussians: none is added nearer to another; those "
        "from before the scale is known in metres stay, and a note says how many; null: as dense "
        "as structure asks for",
    )
    hold_out_every: int = Field(
        8, ge=0, description="i % n == 0 and i != 0 is tracked, never mapped; 0: map every frame"
    )
    lpips_weights: Path | None = Field(
        None,
        description="folder with vgg16-397923af.pth, alexnet-owt-7be5be79.pth or both, as "
        "torchvision publishes them, for LPIPS; null: the one that torch keeps such files in",
    )
    held_out_most: Lab[int] = Field(
        256,
        ge=2,
        description="held-out views of a sub-map, spread over it, that are kept and judged: one "
        "takes heldout_steps, 256 some minutes; no reference clip has as many",
    )
    views_per_keyframe: Lab[int] = Field(
        48,
        ge=2,
        description="views kept for each keyframe, common ones and others each, "
        "spread over its time; the reef clip has 40 common ones at its full 30 fps, 20 at 15",
    )
    insertion: InsertionConfig = InsertionConfig()
    loss: Lab[LossConfig] = LossConfig()
    optimiser: OptimiserConfig = OptimiserConfig()
    medium: MediumConfig = MediumConfig()
    sunlight: Lab[SunlightConfig] = SunlightConfig()
    decoder: Lab[DecoderConfig] = DecoderConfig()
