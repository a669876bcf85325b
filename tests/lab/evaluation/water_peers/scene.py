"""A textured scene seen through known water."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aquaflow.lab.evaluation.water_peers.contract import Pictures, Ranges
from aquaflow.render.image_metrics import channel_gain, psnr

HEIGHT, WIDTH, VIEWS = 96, 128, 2
NEAR, FAR = 0.5, 2.0


@dataclass(frozen=True)
class HazyScene:
    """Pictures in water, without it, and their ranges."""

    seen: Pictures
    clean: Pictures
    z: Ranges


def hazy_scene(beta: tuple[float, float, float], veil: tuple[float, float, float]) -> HazyScene:
    """Fine patches, some of them black, alike at all ranges; I = J exp(-beta z) + backscatter."""
    rng = np.random.default_rng(3)
    albedo = rng.uniform(0.1, 0.9, (VIEWS, HEIGHT // 2, WIDTH // 2, 3))
    albedo[rng.random(albedo.shape[:3]) < 0.1] = 0.0
    clean = albedo.repeat(2, axis=1).repeat(2, axis=2).astype(np.float32)
    z = np.broadcast_to(np.linspace(FAR, NEAR, HEIGHT)[:, None], (VIEWS, HEIGHT, WIDTH))
    through = np.exp(-np.array(beta) * z[..., None])
    seen = clean * through + np.array(veil) * (1.0 - through)
    return HazyScene(seen.astype(np.float32), clean, z.astype(np.float32))


def matched_psnr(pictures: Pictures, clean: Pictures) -> float:
    """dB after one gain per channel."""
    return psnr(np.clip(pictures * channel_gain(pictures, clean), 0.0, 1.0), clean)
