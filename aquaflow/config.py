"""The configuration: one model per stage, unknown keys refused with their path.

Every default says where it comes from: ``paper``, a peer (field_notes.md), or a measurement.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from aquaflow.errors import ConfigError, InputError


class Stage(BaseModel):
    """A stage's settings: immutable, and a misspelt key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class SourceConfig(Stage):
    """Which frames, and how they are prepared."""

    every: int = Field(1, ge=1, description="use every n-th frame")
    start: int = Field(0, ge=0, description="first frame index")
    stop: int | None = Field(None, ge=1, description="first frame index not used")
    width: int | None = Field(
        None, ge=64, description="px; frames are made this wide (None: 480, or less if smaller)"
    )
    crop: str | None = Field(None, description="left | right | x,y,width,height, before resizing")
    fps: float | None = Field(None, gt=0, description="frames/s of a folder without timestamps")


class InitialisationConfig(Stage):
    """Two-view initialisation (prior_notes.md section 2)."""

    points: int = Field(800, ge=100, description="sample points; 800 solve in 0.1 s")
    min_share: float = Field(
        0.25, gt=0, lt=1, description="matched part of the samples below which the place is lost"
    )
    min_views: int = Field(2, ge=1, description="frames beside the reference to judge by")
    max_waiting: int = Field(24, ge=3, description="frames kept while waiting; bounds memory")
    parallax_widths: float = Field(
        0.04,
        gt=0,
        description="rotation-compensated median parallax over width; measured: "
        "0.02 leaves the depth of gentle relief undecided",
    )
    pairs: int = Field(2, ge=1, description="second views tried, most parallax first")
    candidates: int = Field(3, ge=1, description="E and H poses tried per pair")
    focal_factors: tuple[float, ...] = Field(
        (0.7, 1.0, 1.4), description="starts for an unknown focal length, over the guess"
    )
    max_focal_sigma: float = Field(
        0.05, gt=0, description="relative; a focal length known worse than this waits for parallax"
    )
    sigma_px: float = Field(0.5, gt=0, description="noise of a checked DIS match")
    inlier_px: float = Field(1.0, gt=0, description="reprojection error of an explained match")
    min_explained: float = Field(
        0.7, gt=0, le=1, description="explained part of all matches to accept a geometry"
    )
    max_depth_sigma: float = Field(
        0.1, gt=0, description="median relative sigma of the points' depth to accept a geometry"
    )


class TrackingConfig(Stage):
    """Tracking and frame classes (paper, Sec. 3.2)."""

    keyframe_share: float = Field(
        0.7,
        gt=0,
        lt=1,
        description="tau_keyframe: matched share below which a keyframe is made; paper: 0.7",
    )
    mapping_parallax_widths: float = Field(
        30.0 / 512.0, gt=0, description="tau_mapframe over width; paper: 30 px at 512 px"
    )
    matches: int = Field(
        5000, ge=200, description="matches in the pose solver; more gain nothing (prior_notes 4)"
    )
    min_matches: int = Field(40, ge=10, description="fewer decide no pose (prior_notes 4)")
    min_inlier_share: float = Field(
        0.35, gt=0, lt=1, description="inliers below which the frame is lost"
    )
    min_support: float = Field(
        0.1,
        ge=0,
        lt=1,
        description="matched share x inlier share below which the frame is lost; flow between "
        "unrelated pictures reaches 0.08 by chance (`aquaflow stress`, teleport)",
    )
    known_sigma: float = Field(
        0.15, gt=0, description="relative depth sigma of points that poses are solved from"
    )
    sigma_px: float = Field(0.5, gt=0, description="noise of a checked DIS match")
    reuse_encodings: bool = Field(
        True, description="skip: a keyframe's encoding is kept; False: made again for every frame"
    )
    seed_matching: bool = Field(
        True, description="skip: matching starts at the last frame's matches; False: from nothing"
    )
    stop_converged: bool = Field(
        True, description="skip: the pose solver stops when it converged; False: at its last step"
    )
    lost_after: int = Field(
        3, ge=1, description="consecutive lost frames after which a new sub-map starts"
    )
    initialisation: InitialisationConfig = InitialisationConfig()


class MediumConfig(Stage):
    """The water (paper, Sec. 3.3.2)."""

    enabled: bool = Field(True, description="False: the map is what the camera saw, water included")
    width: int = Field(32, ge=4, description="hidden units of MLP_a; paper silent, 32 cost nothing")
    rate: float = Field(
        5e-4, gt=0, description="Adam rate of all medium parameters; 2e-3 drifts off the fit"
    )
    max_gradient: float = Field(
        0.01, gt=0, description="gradient norm kept (WaterSplatting clips at 0.001)"
    )
    first_fit_views: int = Field(
        12,
        ge=2,
        description="views after which water is first fitted to sightings; then at every "
        "doubling, and before refining",
    )
    fit: bool = Field(True, description="False: the water starts from the values below, no fit")
    shading: bool = Field(True, description="False: the fit knows no lamp or lens fall-off")
    fit_views: int = Field(20, ge=4, description="views that a fit looks at, spread over the dive")
    initial_attenuation: float = Field(
        0.1, gt=0, description="1 / map unit; the median range of the first keyframe is 1 unit"
    )
    initial_B_inf: float = Field(0.3, gt=0, lt=1, description="backscatter at infinity")
    initial_B_res: float = Field(0.01, gt=0, lt=1, description="residual backscatter close by")
    initial_residual_decay: float = Field(1.0, gt=0, description="1 / map unit")


class InsertionConfig(Stage):
    """Where new Gaussians go (paper, Sec. 3.3.3)."""

    medium_reduced: bool = Field(
        True, description="False: structure and colours of new Gaussians from the raw picture"
    )
    sigma_px: float = Field(1.0, gt=0, description="sigma of the Laplacian of Gaussian")
    tau_a: float = Field(
        0.02,
        ge=0,
        le=1,
        description="P_a above which a pixel may get a Gaussian; the paper's 1.0 "
        "never fires (DESIGN section 4)",
    )
    density: float = Field(0.5, gt=0, le=1, description="Gaussians per pixel of certain structure")
    bare_probability: float = Field(
        0.06, ge=0, le=1, description="least P_a where the map does not cover the picture"
    )
    covered_alpha: float = Field(0.6, gt=0, lt=1, description="alpha that counts as covered")
    agreement: float = Field(
        0.1, gt=0, description="relative range difference up to which map and prior agree"
    )
    known_sigma: float = Field(
        0.15, gt=0, description="relative range sigma of pixels that may get a Gaussian"
    )
    opacity: float = Field(0.5, gt=0, lt=1, description="of a new Gaussian at full confidence")
    scale_of_spacing: float = Field(
        0.6, gt=0, description="sigma of a new Gaussian over the expected spacing"
    )
    max_spacing_widths: float = Field(0.1, gt=0, description="largest spacing over image width")


class LossConfig(Stage):
    """Weights of the objective (paper, Sec. 3.4 and Implementation Details)."""

    ssim: float = Field(0.2, ge=0, le=1, description="lambda_ssim; paper: 0.2")
    depth: float = Field(0.01, ge=0, description="lambda_d; paper: 0.01")
    scale: float = Field(0.01, ge=0, description="lambda_s; paper: 0.01")
    tau_e: float = Field(0.2, gt=0, description="residual masked on common frames (ARTDECO: 0.2)")


class OptimiserConfig(Stage):
    """Adam rates and the number of steps."""

    betas: tuple[float, float] = Field((0.9, 0.99), description="Adam's decay rates")
    means: float = Field(4e-4, gt=0, description="map units per step")
    means_final: float = Field(0.1, gt=0, le=1, description="factor reached at the end of refining")
    quats: float = Field(2e-3, gt=0)
    log_scales: float = Field(8e-3, gt=0)
    opacity_logits: float = Field(0.04, gt=0)
    raw_colours: float = Field(6e-3, gt=0)
    poses: float = Field(1e-4, ge=0, description="rad and map units; ARTDECO: 1e-4; 0: held")
    steps_keyframe: int = Field(20, ge=0, description="steps after a keyframe (ARTDECO: 20)")
    steps_mapping: int = Field(20, ge=0, description="steps after a mapping frame (ARTDECO: 20)")
    steps_common: int = Field(5, ge=0, description="steps after a common frame (ARTDECO: 10)")
    newest_share: float = Field(0.2, ge=0, le=1, description="steps on the newest view (ARTDECO)")
    refine_steps: int = Field(1500, ge=0, description="steps after the last frame")
    refine_seconds: float | None = Field(
        None, gt=0, description="time limit of refining; makes runs differ from each other"
    )
    prune_every: int = Field(200, ge=1)
    prune_opacity: float = Field(0.02, gt=0, lt=1, description="opacity that is not worth keeping")
    prune_radius_widths: float = Field(0.5, gt=0, description="largest radius over image width")
    heldout_steps: int = Field(40, ge=0, description="pose steps of a held-out view, map frozen")
    heldout_rate: float = Field(5e-4, gt=0, description="rad and map units")


class MappingConfig(Stage):
    """The map (paper, Sec. 3.3 and 3.4)."""

    enabled: bool = Field(True, description="False: trajectory only")
    renderer: Literal["auto", "cpu", "tiles", "gsplat"] = "auto"
    max_gaussians: int = Field(150_000, ge=1000, description="hard cap")
    hold_out_every: int = Field(
        8, ge=0, description="i % n == 0 and i != 0 is tracked, never mapped; 0: map every frame"
    )
    insertion: InsertionConfig = InsertionConfig()
    loss: LossConfig = LossConfig()
    optimiser: OptimiserConfig = OptimiserConfig()
    medium: MediumConfig = MediumConfig()


class Config(Stage):
    """Everything a run depends on."""

    seed: int = 0
    threads: int | None = Field(None, ge=1, description="None: every core")
    prior: Literal["classical"] = "classical"
    source: SourceConfig = SourceConfig()
    tracking: TrackingConfig = TrackingConfig()
    mapping: MappingConfig = MappingConfig()


def parse_config(data: dict[str, Any], origin: str) -> Config:
    """Validate a mapping read from ``origin``.

    Raises:
        ConfigError: with the path of the first key that is unknown or out of range.
    """
    try:
        return Config.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        path = ".".join(str(part) for part in first["loc"])
        problem = "is not a known key" if first["type"] == "extra_forbidden" else first["msg"]
        raise ConfigError(f"{origin}: '{path}' {problem.lower()}; see `aquaflow config`") from error


def load_config(path: Path) -> Config:
    """Read a YAML config; keys that are absent keep their defaults.

    Raises:
        InputError: the file cannot be read, or is not YAML.
        ConfigError: a key is unknown or a value out of range.
    """
    try:
        data = yaml.safe_load(path.read_text()) or {}
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not text"
        raise InputError(f"cannot read the config {path}: {reason}; give a YAML file") from error
    except yaml.YAMLError as error:
        raise InputError(f"{path} is not YAML; write `key: value` lines") from error
    if not isinstance(data, dict):
        raise ConfigError(f"{path} holds no key: value pairs; see `aquaflow config`")
    return parse_config(data, str(path))


def dump_config(config: Config, path: Path) -> None:
    """Write the effective configuration."""
    path.write_text(yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False))
