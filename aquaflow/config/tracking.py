"""Settings of tracking (paper, Sec. 3.2)."""

from __future__ import annotations

from pydantic import Field

from aquaflow.config.stage import Stage


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
