"""Settings of tracking (paper, Sec. 3.2) and of the two-view prior."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from aquaflow.config.stage import Lab, StageConfig

PoseResidual = Literal["point", "ray", "pixel"]
"""What a pose is solved from: points against points (the paper), rays, or calibrated pixels."""


class InitialisationConfig(StageConfig):
    """Two-view initialisation (notes/2026-11-tracking.md#initialisation)."""

    points: int = Field(800, ge=100, description="sample points; 800 solve in 0.1 s")
    min_share: float = Field(
        0.25, gt=0, lt=1, description="matched part of the samples below which the place is lost"
    )
    min_views: int = Field(2, ge=1, description="frames needed in addition to the reference")
    max_waiting: int = Field(24, ge=3, description="frames kept while waiting; bounds memory")
    parallax_widths: float = Field(
        0.04,
        gt=0,
        description="rotation-compensated median parallax over width; measured: "
        "0.02 leaves the depth of gentle relief undecided",
    )
    pairs: int = Field(2, ge=1, description="second views tried, most parallax first")
    candidates: int = Field(3, ge=1, description="E and H poses tried per pair")
    judges: int = Field(
        6, ge=2, description="waiting frames that each candidate is adjusted to; the best is then "
        "adjusted to those with most parallax",
    )  # fmt: skip
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


class GateConfig(StageConfig):
    """The frame gate: what is skipped before anything costly looks at it.

    See docs/architecture.md#skips.
    """

    skip_duplicates: Lab[bool] = Field(
        True, description="skip: nothing moved since the last frame used"
    )
    skip_dark: Lab[bool] = Field(
        True, description="skip: too little light for texture above the noise"
    )
    skip_blurred: Lab[bool] = Field(
        True, description="skip: detail gone, against the frames before"
    )
    skip_blinded: Lab[bool] = Field(
        True, description="skip: lamp glare, silt, open water: no texture"
    )
    longest_run: Lab[int] = Field(
        5,
        ge=0,
        description="dark, blurred or blinded frames skipped in a row; after them all pass until "
        "one is good, so that tracking knows it is lost and a misjudged dive is still tracked",
    )


class RetrievalConfig(StageConfig):
    """Candidates for loop closure and relocalisation."""

    words: int = Field(
        4096, ge=64, description="of the vocabulary; measured: 1024 separate half as well"
    )
    min_descriptors: int = Field(
        100, ge=2, description="a picture with fewer is not remembered and not looked for"
    )
    neighbour_share: float = Field(
        0.5,
        ge=0,
        le=1,
        description="similarity of a plausible candidate over the median of consecutive keyframes",
    )
    min_similarity: float = Field(
        0.02,
        ge=0,
        description="of a plausible candidate; measured: other places seldom reach it",
    )
    candidates: int = Field(3, ge=1, description="verified for each keyframe; MASt3R-SLAM: 3")


class GraphConfig(StageConfig):
    """The keyframe graph: robust Sim(3) pose-graph optimisation."""

    enabled: bool = Field(True, description="False: no loops are looked for, no sub-maps merged")
    loop_gap: int = Field(
        12, ge=1, description="keyframes between which a link is no loop (ARTDECO: 12)"
    )
    huber_sigmas: float = Field(
        3.75,
        gt=0,
        description="whitened residual from which an edge counts linearly; chi2(7), 95 %",
    )
    loop_chi2: float = Field(
        24.3,
        gt=0,
        description="squared residual a loop edge may keep at full trust; chi2(7), 99.9 %",
    )
    drift_factor: float = Field(
        2.0,
        ge=1,
        description="times worse than its covariance that the chain may have drifted for a single "
        "loop edge to be accepted; false loops: tests/tracking/graph/test_loop_admission.py",
    )
    corroborated_drift_factor: float = Field(
        30.0,
        ge=1,
        description="the same for loop edges that corroborate each other; drift of monocular scale "
        "has always the same sign, so it outgrows its covariance (notes/2026-11-tracking.md)",
    )
    corroboration_window: int = Field(
        30, ge=1, description="keyframes between the ends of loop edges that may corroborate"
    )
    tolerance_sigmas: float = Field(
        0.05,
        gt=0,
        description="poses that would move less, in own sigmas, stay as they are; synthetic survey "
        "of 2,500 keyframes: ATE 1 % off the full solution (0.15: 4 %; 0.03: none, twice the time)",
    )
    max_iterations: int = Field(
        60, ge=1, description="steps of one descent; 6 to 35 for 10,000 keyframes"
    )


class AdjustmentConfig(StageConfig):
    """Joint adjustment of keyframe poses and depths (docs/adjustment.md)."""

    enabled: bool = Field(True, description="False: links stay as tracking measured them")
    window: int = Field(
        6, ge=3, description="keyframes adjusted together when one is made; bounds its time"
    )
    reach: int = Field(
        3,
        ge=1,
        description="keyframes back that a new one is matched with; synthetic forward view of 60 "
        "keyframes, all adjusted at once: ATE 0.124 to 0.060 %; beyond, little overlaps",
    )
    points: int = Field(
        300,
        ge=40,
        description="of each keyframe; with 4,000 the error of two real clips changes by 4 %",
    )
    iterations: int = Field(10, ge=1, description="most steps between two estimates of the noise")
    at_end: bool = Field(True, description="adjust all keyframes together once, at the end")
    at_loops: int = Field(
        10,
        ge=0,
        description="keyframes between two adjustments of all keyframes after loops; 0: none",
    )
    at_loops_share: float = Field(
        0.25,
        ge=0,
        description="as many of them as this share of those adjusted before, where that is more: "
        "an adjustment takes time by their number (notes/2026-11-speed.md#growth)",
    )
    most_at_loops: int = Field(
        300, ge=2, description="keyframes beyond which loops are left to the end; bounds its time"
    )


class LearnedConfig(StageConfig):
    """What a prior that knows ranges (X, Q) is used for; a classical one knows none."""

    depth: bool = Field(
        True,
        description="pixels of key and mapping frames that are not triangulated, or worse, get the "
        "learned depth",
    )
    scale: bool = Field(
        True,
        description="the network's unit holds the map's where it drifts by more than the network "
        "errs, and no telemetry knows it",
    )
    moving: bool = Field(
        True,
        description="regions whose triangulated depth the learned one contradicts move by "
        "themselves and are kept from the map",
    )
    start: bool = Field(
        False,
        description="a map starts at the second picture where ranges are certain enough; the poses "
        "until parallax decides are off by as much as the ranges, which costs accuracy",
    )
    start_sigma: float = Field(
        0.1,
        gt=0,
        description="relative sigma of a learned range up to which a map starts from it",
    )


class MonitorConfig(StageConfig):
    """The monitor of consistency (docs/frame.md#consistency)."""

    enabled: bool = Field(True, description="False: a wrong scale is not looked for")
    every: int = Field(10, ge=1, description="frames with a pose between two checks")
    max_change: float = Field(
        0.03,
        gt=0,
        description="relative change of a keyframe's depths since it was first left; measured: "
        "0.1 % at most on the reef and Curasao clips and at one place at 160 px, 2 % at 112 px",
    )
    max_gap: float = Field(
        0.05,
        gt=0,
        description="relative difference of scale from most keyframes around; measured there: "
        "0.2 % from the keyframe before, 1.8 % over eight, 1 % at one place",
    )


class VerificationConfig(StageConfig):
    """When a place counts as found again. Measured on all shared clips: in 912 pairs of different
    places at most 19 keypoints match and none agree on a pose; where a clip's frames still share a
    third of the picture, at least 160 do, in 18 cells."""

    min_inliers: int = Field(40, ge=10, description="keypoints that agree on the pose")
    min_inlier_share: float = Field(
        0.8, gt=0, le=1, description="of the matched keypoints; measured: below it, poses are bad"
    )
    min_cells: int = Field(
        8, ge=1, le=48, description="of 8 x 6 cells with an inlier: one fish is no place"
    )
    inlier_px: float = Field(3.0, gt=0, description="reprojection error of an inlier")
    sigma_px: float = Field(1.0, gt=0, description="noise of a keypoint at wide baseline")
    known_sigma: float = Field(
        0.15, gt=0, description="relative depth sigma of points that poses are solved from"
    )
    max_scale_sigma: float = Field(
        0.05,
        gt=0,
        description="relative; two pointmaps whose scales are known worse are not joined",
    )


class TrackingConfig(StageConfig):
    """Tracking and frame classes (paper, Sec. 3.2)."""

    keyframe_share: Lab[float] = Field(
        0.7,
        gt=0,
        lt=1,
        description="tau_keyframe: matched share below which a keyframe is made; paper: 0.7",
    )
    return_candidates: Lab[int] = Field(
        2, ge=0, description="earlier keyframes tried, each for one more matching; 0: none"
    )
    crowd: Lab[int] = Field(
        3,
        ge=1,
        description="earlier keyframes of a place that are enough: no more are made there while "
        "one of them, or the one in use, still shows crowd_share",
    )
    crowd_share: Lab[float] = Field(
        0.4,
        gt=0,
        lt=1,
        description="matched share down to which a keyframe stays in use in a crowded place",
    )
    crowd_look_s: Lab[float] = Field(
        1.0,
        ge=0,
        description="s; in a crowded place another keyframe is looked for so often at most; 0: at "
        "every frame, and the reef swum there and back takes 140 instead of 60 ms a frame there",
    )
    judge_hidden: Lab[bool] = Field(
        True,
        description="what hides the scene makes no keyframe and no mapping frame; False: few "
        "matches always make a keyframe (the paper)",
    )
    mapping_parallax_widths: Lab[float] = Field(
        30.0 / 512.0, gt=0, description="tau_mapframe over width; paper: 30 px at 512 px"
    )
    matches: Lab[int] = Field(
        5000,
        ge=200,
        description="matches in the pose solver; more gain nothing (notes/2026-11-tracking.md)",
    )
    min_matches: Lab[int] = Field(
        40, ge=10, description="fewer decide no pose (notes/2026-11-tracking.md)"
    )
    min_inlier_share: Lab[float] = Field(
        0.35, gt=0, lt=1, description="inliers below which the frame is lost"
    )
    sure_inlier_share: Lab[float] = Field(
        0.85,
        gt=0,
        le=1,
        description="inliers from which a pose after a wide step has no rival: flow that is a tile "
        "off leaves 0.4 to 0.8 of the matches (synthetic pool), right flow over 0.85",
    )
    least_known_share: Lab[float] = Field(
        0.05,
        ge=0,
        le=1,
        description="of the matches, those of known depth, below which others are triangulated "
        "first",
    )
    min_support: Lab[float] = Field(
        0.1,
        ge=0,
        lt=1,
        description="matched share x inlier share below which the frame is lost; flow between "
        "unrelated pictures reaches 0.08 by chance (`aquaflow lab stress`, teleport)",
    )
    known_sigma: Lab[float] = Field(
        0.15, gt=0, description="relative depth sigma of points that poses are solved from"
    )
    sigma_px: Lab[float] = Field(
        0.2, gt=0, description="noise of a refined match; 0.15 px measured on synthetic dives"
    )
    residual: Lab[PoseResidual] = Field(
        "pixel",
        description="what poses are solved from; point is the paper's and needs the frame's own "
        "points; RMS error of t over the baseline at 5 % depth noise: point 3.6, ray 1.9, pixel "
        "0.4 % (tests/tracking/pose/test_residuals.py); on the reef clip ray and pixel are equal",
    )
    reuse_encodings: Lab[bool] = Field(
        True, description="skip: a keyframe's encoding is kept; False: made again for every frame"
    )
    seed_matching: Lab[bool] = Field(
        True, description="skip: matching starts at the last frame's matches; False: from nothing"
    )
    stop_converged: Lab[bool] = Field(
        True, description="skip: the pose solver stops when it converged; False: at its last step"
    )
    mask_overlays: bool = Field(
        True,
        description="what stays in the picture while the scene moves (clock, crosshair, logo, the "
        "vehicle's own arm) is masked for tracking and map",
    )
    recent_keyframes: Lab[int] = Field(
        3, ge=0, description="keyframes left last that a lost frame is looked for in; 0: none"
    )
    lost_after: Lab[int] = Field(
        3, ge=1, description="consecutive lost frames after which a new sub-map starts"
    )
    initialisation: Lab[InitialisationConfig] = InitialisationConfig()
    gate: Lab[GateConfig] = GateConfig()
    graph: Lab[GraphConfig] = GraphConfig()
    adjustment: Lab[AdjustmentConfig] = AdjustmentConfig()
    learned: Lab[LearnedConfig] = LearnedConfig()
    monitor: Lab[MonitorConfig] = MonitorConfig()
    retrieval: Lab[RetrievalConfig] = RetrievalConfig()
    verification: Lab[VerificationConfig] = VerificationConfig()


# --------------------------------------------------------------------------------------------------
# Settings of the two-view prior.


class PriorConfig(StageConfig):
    """Which prior tracks, and where its network runs (paper, Sec. 3.1)."""

    kind: Literal["compact", "classical", "folder", "xfeat", "aliked"] = Field(
        "classical",
        description="compact: learned coarse matches, refined by flow; without its weights or "
        "onnxruntime, classical replaces it, with a warning. classical: SIFT homography and flow, "
        "no network. folder: the exported prior in `folder`, or an error. xfeat, aliked: flow from "
        "the matches of XFeat or of ALIKED and LightGlue, which are installed apart, or an error",
    )
    folder: Path | None = Field(
        None,
        description="what `aquaflow lab prior export` or `prior train` wrote; None: what ships",
    )
    confidence: Lab[bool] = Field(
        True, description="C weighs matches; False: all count the same (`aquaflow lab ablate`)"
    )
    learned_matches: Lab[bool] = Field(
        True,
        description="flow starts at the network's matches; False: at keypoints', as without one",
    )
    matches: Lab[Literal["flow", "network"]] = Field(
        "flow",
        description="network: those of its points and descriptors, as published, if it gives them "
        "for all pixels, as mast3r does; else flow's, with a warning. flow: which starts there",
    )
    device: Literal["auto", "cpu", "cuda", "tensorrt"] = Field(
        "auto", description="auto: the fastest that onnxruntime has; any other is that or an error"
    )
    precision: Literal["auto", "fp32", "fp16", "int8"] = Field(
        "auto",
        description="auto: of the compact network int8 on a processor, else fp16 on TensorRT and "
        "fp32; fp16: TensorRT or an error",
    )
    threads: int = Field(
        1, ge=1, description="of the network; mapping runs in parallel and needs the other cores"
    )
    engine_cache: Path | None = Field(
        None,
        description="folder that TensorRT keeps its engines in, for building one takes minutes; "
        "None: aquaflow/tensorrt in the user's cache directory",
    )

    @model_validator(mode="after")
    def _folder_is_named(self) -> PriorConfig:
        if self.kind == "folder" and self.folder is None:
            raise ValueError("kind folder needs a folder")
        return self
