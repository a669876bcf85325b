"""Settings of objects of known size that give the map its scale."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field, model_validator

from aquaflow.config.stage import StageConfig

Dictionary: TypeAlias = Literal[
    "APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h10", "APRILTAG_36h11",
    "4X4_50", "4X4_100", "4X4_250", "4X4_1000", "5X5_50", "5X5_100", "5X5_250", "5X5_1000",
    "6X6_50", "6X6_100", "6X6_250", "6X6_1000", "7X7_50", "7X7_100", "7X7_250", "7X7_1000",
    "ARUCO_ORIGINAL", "ARUCO_MIP_36h12",
]  # fmt: skip
"""Names of OpenCV's predefined dictionaries, without DICT_."""


class MarkersConfig(StageConfig):
    """AprilTag or ArUco markers that lie anywhere, each of the same size."""

    kind: Literal["markers"] = "markers"
    dictionary: Dictionary
    marker_m: float = Field(gt=0, description="m, side of the black square")
    sigma_m: float = Field(0.0005, gt=0, description="m, 1 sigma of marker_m (judgement: a ruler)")
    ids: tuple[int, ...] = Field((), description="of the markers in use; none: every one counts")


class CharucoConfig(StageConfig):
    """A ChArUco board: a chessboard with markers in its white squares."""

    kind: Literal["charuco"] = "charuco"
    dictionary: Dictionary
    columns: int = Field(ge=3, le=100, description="squares from left to right")
    rows: int = Field(ge=3, le=100, description="squares from top to bottom")
    square_m: float = Field(gt=0, description="m, side of a chessboard square")
    marker_m: float = Field(gt=0, description="m, side of a marker's black square")
    sigma_m: float = Field(0.0005, gt=0, description="m, 1 sigma of square_m (judgement: a ruler)")
    legacy: bool = Field(False, description="printed by OpenCV before 4.6 with an even row count")

    @model_validator(mode="after")
    def _markers_fit(self) -> CharucoConfig:
        if self.marker_m >= self.square_m:
            raise ValueError("marker_m must be smaller than square_m")
        return self


BoardConfig: TypeAlias = Annotated[MarkersConfig | CharucoConfig, Field(discriminator="kind")]


class LasersConfig(StageConfig):
    """Two laser dots, whose beams run parallel to the optical axis."""

    colour: Literal["red", "green", "blue"]
    spacing_m: float = Field(gt=0, description="m between the beams")
    sigma_m: float = Field(0.001, gt=0, description="m, 1 sigma of spacing_m (judgement: a ruler)")
    parallel_sigma_deg: float = Field(
        0.1,
        ge=0,
        description="deg, 1 sigma of each beam against the axis; at 2 m, 0.1 deg are 3.5 mm "
        "(judgement: set by eye on a wall)",
    )
