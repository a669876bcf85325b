"""Settings of the two-view prior."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from aquaflow.config.stage import Lab, StageConfig


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
