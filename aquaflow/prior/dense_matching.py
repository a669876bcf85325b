"""Dense matches of a network that gives points and a descriptor for every pixel of a pair.

Where a pixel's point is seen in the other picture is found in two steps: the pixel whose ray comes
nearest to the point (Murai et al., MASt3R-SLAM, CVPR 2025, Sec. 3.2; written from its equations),
then, around it, the pixel whose descriptor is most alike. Neither needs the camera, or the pixel's
neighbours; both err where the network does, so flow measures from there, unless the config asks
for the paper's matches (notes/2026-11-priors.md#dense-matching).
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.prior.contract import Float, Mask
from aquaflow.prior.flow import MIN_TEXTURE, ImageFlow, check, pixel_grid
from aquaflow.render.library import Library, library_or_none

Array = npt.NDArray[np.floating]

ITERATIONS = 10
"""Most steps of a match; from where the pixel itself lies most need four."""
DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-6, 1e3
"""Of the normal equations, over their mean diagonal: at first, and at either end."""
LEAST_SLOPE = 1e-12
"""Squared, of rays over pixels, added to the same: where all rays are one, no step is infinite."""
STILL_PX = 0.01
"""A shorter step is the last one."""
EVERY_PX = 4
"""Pixels between those of a picture whose matches flow starts from, across and down: it starts no
better from all, which takes eight times as long (notes/2026-11-priors.md#dense-matching)."""
MEDIAN = 5
"""Such pixels across and down whose median is taken: flow is smooth, single matches are not."""
SIGMA_PX = 0.5
"""Error of matches that flow does not measure, both ways: with 0.36 px each as in the notes."""
RAY_PX = 1.5
"""A point whose ray is farther from all of the picture's lies outside of it."""
OCCLUDED = 0.2
"""Relative difference of two ranges from which one hides the other; networks err by some percent in
each."""
DILATIONS_PX = (8, 4, 2, 1)
"""Steps of the search among descriptors, one after the other, each RADIUS steps to all sides."""
RADIUS = 1
LEAST_CURVATURE = 1e-4
"""Of the products of descriptors around the best: below, there is no top between pixels."""
SHORTEST = 1e-6
"""Length below which a point has no direction."""


@dataclass(frozen=True)
class DenseViews:
    """What a network says of every pixel of two pictures a and b, which the fields cover evenly."""

    points_a: Float
    """[h, w, 3] in b's frame"""
    points_b: Float
    """[h', w', 3] in b's frame"""
    descriptors_a: Float
    """[h, w, d] of length 1"""
    descriptors_b: Float
    """[h', w', d] of length 1"""
    threads: int = 1

    def match(self, every: int = 1) -> tuple[Float, Mask]:
        """[rows, columns, 2] px of b where each ``every``-th pixel of a, across and down, is seen,
        and [rows, columns] which of them are known: not those that are hidden, out of view or no
        numbers. What is no number costs its own matches only."""
        (h, w), (h_b, w_b) = self.points_a.shape[:2], self.points_b.shape[:2]
        rays, sound = ray_image(self.points_b)
        points, descriptors = thinned(self.points_a, every), thinned(self.descriptors_a, every)
        start = thinned(pixel_grid(h, w), every) * np.array([w_b / w, h_b / h], np.float32)
        pixels, off = project(rays, unit_rays(points)[0], start, self.threads)
        known = (off < RAY_PX) & self._is_seen(points, pixels, sound)
        pixels, score = search(pixels, descriptors, self.descriptors_b, self.threads)
        return pixels, known & (score > 0.0)

    def flow(self, height: int, width: int) -> Float | None:
        """[height, width, 2] px, displacement of a's pixels, in pictures of that size, for dense
        flow to start from; None: nothing is known."""
        moved, known = self.displacement(height, width, EVERY_PX)
        if not known.any():
            return None
        smooth = cv2.merge([cv2.medianBlur(axis, MEDIAN) for axis in cv2.split(moved)])
        return np.asarray(cv2.resize(smooth, (width, height)), dtype=np.float32)

    def displacement(self, height: int, width: int, every: int) -> tuple[Float, Mask]:
        """[rows, columns, 2] px of pictures of that size, of each ``every``-th pixel of a, and
        [rows, columns] which are known; the others move as what is around them."""
        pixels, known = self.match(every)
        (h, w), (h_b, w_b) = self.points_a.shape[:2], self.points_b.shape[:2]
        here = thinned(pixel_grid(h, w), every) * np.array([width / w, height / h], np.float32)
        there = pixels * np.array([width / w_b, height / h_b], np.float32)
        return continued(there - here, known), known

    def _is_seen(
        self,
        points: Float,  # [rows, columns, 3] of a, in b's frame
        pixels: Float,  # [rows, columns, 2] px of b
        sound: Mask,  # [h', w'] where b has points
    ) -> Mask:
        """[rows, columns] False where b shows another surface there, or none."""
        height, width = sound.shape
        x = np.clip(pixels[..., 0], 0, width - 1).astype(np.intp)
        y = np.clip(pixels[..., 1], 0, height - 1).astype(np.intp)
        with np.errstate(over="ignore"):
            there, own = (np.linalg.norm(each, axis=-1) for each in (self.points_b[y, x], points))
        return np.asarray(sound[y, x] & (np.abs(own - there) < OCCLUDED * there))


def matches_both_ways(
    there: DenseViews,
    back: DenseViews,
    height: int,
    width: int,
) -> ImageFlow:
    """Matches as published, in pictures of that size, that agree both ways; neither needs texture.

    Args:
        there: to match a in b.
        back: to match b in a.
    """
    size, textured = (width, height), np.full((height, width), 2.0 * MIN_TEXTURE, np.float32)
    (forward, known), (backward, _) = (v.displacement(height, width, 1) for v in (there, back))
    forward, backward = (
        np.asarray(cv2.resize(each, size), np.float32) for each in (forward, backward)
    )
    known = cv2.resize(known.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    error, valid = check(forward, backward, textured, textured)
    return ImageFlow(forward, backward, error, np.asarray(valid & known), SIGMA_PX)


def thinned(
    field: Array,  # [h, w, ...]
    every: int,
) -> Float:
    """[rows, columns, ...] each ``every``-th pixel, across and down, of the middle ones."""
    return np.asarray(field[every // 2 :: every, every // 2 :: every], dtype=np.float32)


# --------------------------------------------------------------------------------------------------
# Nearest ray: Levenberg-Marquardt over the pixel, on the picture of unit rays.


def unit_rays(
    points: Array,  # [h, w, 3]
) -> tuple[Float, Mask]:
    """[h, w, 3] directions, NaN where there is none, and [h, w] where there is one."""
    with np.errstate(all="ignore"):
        distance = np.linalg.norm(points, axis=-1)
        sound = np.isfinite(distance) & (distance > SHORTEST)
        rays = points / np.where(sound, distance, np.nan)[..., None]
    return np.asarray(rays, dtype=np.float32), sound


def ray_image(
    points: Array,  # [h, w, 3] in the camera's own frame
) -> tuple[Float, Mask]:
    """[h, w, 3] unit rays of all pixels, and [h, w] which of them are the points' own: a camera's
    rays are smooth, so what is missing continues what is around it."""
    rays, sound = unit_rays(points)
    return continued(rays, sound), sound


def project(
    rays: Float,  # [h', w', 3] unit
    wanted: Float,  # [h, w, 3] unit; NaN: none
    start: Float,  # [h, w, 2] px
    threads: int = 1,
) -> tuple[Float, Float]:
    """As :func:`project_by_numpy`, in compiled code where there is some."""
    library = library_or_none()
    if library is None or min(rays.shape[:2]) < 2:
        return project_by_numpy(rays, wanted, start)
    return _project_compiled(library, rays, wanted, start, threads)


def project_by_numpy(
    rays: Array,  # [h', w', 3] unit
    wanted: Array,  # [h, w, 3] unit; NaN: none
    start: Array,  # [h, w, 2] px
) -> tuple[Float, Float]:
    """[h, w, 2] px whose ray is nearest to the wanted one, found from ``start``, and [h, w] px by
    which it is off: NaN where no ray is wanted, large where none is like it."""
    most = np.array([rays.shape[1] - 1, rays.shape[0] - 1], rays.dtype)
    at = np.clip(np.nan_to_num(start.astype(rays.dtype) - rays.dtype.type(0.5)), 0.0, most)
    damping = np.full(at.shape[:-1], DAMPING, rays.dtype)
    moving = np.ones(damping.shape, dtype=bool)
    ray, jacobian = ray_and_jacobian(rays, at)
    for _ in range(ITERATIONS):
        error = ray - wanted
        normal = np.einsum("...ki,...kj->...ij", jacobian, jacobian)
        gradient = np.einsum("...ki,...k->...i", jacobian, error)
        more = 0.5 * damping * np.trace(normal, axis1=-2, axis2=-1) + LEAST_SLOPE
        xx, yy, xy = normal[..., 0, 0] + more, normal[..., 1, 1] + more, normal[..., 0, 1]
        gx, gy = gradient[..., 0], gradient[..., 1]
        step = np.stack([xy * gy - yy * gx, xy * gx - xx * gy], -1) / (xx * yy - xy * xy)[..., None]
        there = np.clip(np.where(np.isfinite(step), at + step, at), 0.0, most)
        new_ray, new_jacobian = ray_and_jacobian(rays, there)
        cost, new_cost = (np.sum((each - wanted) ** 2, -1) for each in (ray, new_ray))
        better = moving & (new_cost < cost)
        moved = np.abs(there - at).max(-1)
        at = np.where(better[..., None], there, at)
        ray = np.where(better[..., None], new_ray, ray)
        jacobian = np.where(better[..., None, None], new_jacobian, jacobian)
        damping = np.where(better, np.maximum(0.1 * damping, LEAST_DAMPING), 10.0 * damping)
        moving &= (moved >= STILL_PX) & (damping <= MOST_DAMPING)
    per_px = np.sqrt(np.maximum(0.5 * np.sum(jacobian**2, axis=(-2, -1)), LEAST_SLOPE))
    off = np.linalg.norm(ray - wanted, axis=-1) / per_px
    return np.asarray(at + 0.5, dtype=np.float32), np.asarray(off, dtype=np.float32)


def ray_and_jacobian(
    rays: Array,  # [h, w, 3]
    at: Array,  # [..., 2] index: pixels less 0.5, in the picture
) -> tuple[Array, Array]:
    """[..., 3] the ray between four pixels, bilinear, and [..., 3, 2] per px."""
    corner = np.minimum(at.astype(np.intp), [rays.shape[1] - 2, rays.shape[0] - 2])
    corner = np.maximum(corner, 0)
    x, y = corner[..., 0], corner[..., 1]
    right, down = np.minimum(x + 1, rays.shape[1] - 1), np.minimum(y + 1, rays.shape[0] - 1)
    fx, fy = (at - corner.astype(at.dtype))[..., None, :].transpose(-1, *range(at.ndim))
    above, below = rays[y, right] - rays[y, x], rays[down, right] - rays[down, x]
    first, second = rays[y, x] + fx * above, rays[down, x] + fx * below
    ray = first + fy * (second - first)
    return ray, np.stack([above + fy * (below - above), second - first], -1)


class _ProjectRays(ctypes.Structure):
    """``ProjectRays`` of native/match_points.h."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("rays", "wanted")),
        *((name, ctypes.c_int32) for name in ("width", "height", "count", "iterations")),
        *((name, ctypes.c_float) for name in ("damping", "least_damping", "most_damping")),
        *((name, ctypes.c_float) for name in ("least_slope", "still_px")),
        *((name, ctypes.c_void_p) for name in ("pixels", "off")),
    )


def _project_compiled(
    library: Library,
    rays: Float,  # [h', w', 3]
    wanted: Float,  # [h, w, 3]
    start: Float,  # [h, w, 2] px
    threads: int,
) -> tuple[Float, Float]:
    rays, wanted = _packed(rays), _packed(wanted)
    pixels = np.array(start, np.float32, order="C")
    if pixels.shape != (*wanted.shape[:-1], 2) or rays.shape[-1] != 3 or wanted.shape[-1] != 3:
        raise ValueError("project takes two pictures of rays, and a start for each ray wanted")
    off = np.empty(wanted.shape[:-1], np.float32)
    height, width = rays.shape[:2]
    given = _ProjectRays(
        rays.ctypes.data, wanted.ctypes.data, width, height, off.size, ITERATIONS,
        DAMPING, LEAST_DAMPING, MOST_DAMPING, LEAST_SLOPE, STILL_PX,
        pixels.ctypes.data, off.ctypes.data,
    )  # fmt: skip
    library.call("aq_project_rays", ctypes.byref(given), threads)
    return pixels, off


# --------------------------------------------------------------------------------------------------
# Most alike descriptor: from coarse to fine around the match so far.


def search(
    pixels: Float,  # [h, w, 2] px of b
    a: Float,  # [h, w, d]
    b: Float,  # [h', w', d]
    threads: int = 1,
) -> tuple[Float, Float]:
    """As :func:`search_by_numpy`, in compiled code where there is some."""
    library = library_or_none()
    if library is None:
        return search_by_numpy(pixels, a, b)
    return _search_compiled(library, pixels, a, b, threads)


def search_by_numpy(
    pixels: Array,  # [h, w, 2] px of b
    a: Array,  # [h, w, d]
    b: Array,  # [h', w', d]
) -> tuple[Float, Float]:
    """[h, w, 2] px, each moved to where the product of descriptors is largest, and to the top of
    the parabola through it and its neighbours; [h, w] the product, 0 where there is none."""
    height, width = b.shape[:2]
    inside = np.asarray(((pixels >= 0.0) & (pixels <= [width, height])).all(-1))
    start = np.where(inside[..., None], pixels, 0.0).astype(np.intp)
    start = np.minimum(start, [width - 1, height - 1])
    at, best = start, _product(a, b, start)
    for dilation in DILATIONS_PX:
        centre = at
        for down in range(-RADIUS, RADIUS + 1):
            for right in range(-RADIUS, RADIUS + 1):
                to = centre + np.array([right, down]) * dilation
                score = _product(a, b, to)
                better = score > best
                at, best = np.where(better[..., None], to, at), np.where(better, score, best)
    found = inside & np.isfinite(best)
    own = np.where(at == start, pixels - at - 0.5, 0.0)
    shift = np.stack([_peak(a, b, at, best, own, axis) for axis in (0, 1)], -1)
    refined = np.where(found[..., None], at + 0.5 + shift, pixels)
    return refined.astype(np.float32), np.where(found, best, 0.0).astype(np.float32)


def _product(
    a: Array,  # [h, w, d]
    b: Array,  # [h', w', d]
    at: npt.NDArray[np.intp],  # [h, w, 2]
) -> Array:
    """[h, w]; -inf outside of b, and of what is no number."""
    height, width = b.shape[:2]
    inside = ((at >= 0) & (at < [width, height])).all(-1)
    x, y = np.clip(at[..., 0], 0, width - 1), np.clip(at[..., 1], 0, height - 1)
    with np.errstate(all="ignore"):
        product = np.einsum("...d,...d->...", a, b[y, x])
    return np.where(inside & np.isfinite(product), product, -np.inf)


def _peak(
    a: Array,  # [h, w, d]
    b: Array,  # [h', w', d]
    at: npt.NDArray[np.intp],  # [h, w, 2]
    best: Array,  # [h, w]
    own: Array,  # [h, w, 2]
    axis: int,
) -> Array:
    """[h, w] px in [-0.5, 0.5] along ``axis``; where there is no top, what the match had."""
    one = np.eye(2, dtype=np.intp)[axis]
    before, after = _product(a, b, at - one), _product(a, b, at + one)
    with np.errstate(all="ignore"):
        curvature = 2.0 * best - before - after
        shift = np.clip(0.5 * (after - before) / curvature, -0.5, 0.5)
    topped = np.isfinite(curvature) & (curvature > LEAST_CURVATURE)
    return np.where(topped, shift, own[..., axis])


class _SearchDescriptors(ctypes.Structure):
    """``SearchDescriptors`` of native/match_points.h."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("a", "b")),
        *((name, ctypes.c_int32) for name in ("width", "height", "count", "d")),
        ("dilations", ctypes.c_void_p),
        *((name, ctypes.c_int32) for name in ("levels", "radius")),
        ("least_curvature", ctypes.c_float),
        *((name, ctypes.c_void_p) for name in ("pixels", "score")),
    )


def _search_compiled(
    library: Library,
    pixels: Float,  # [h, w, 2] px
    a: Float,  # [h, w, d]
    b: Float,  # [h', w', d]
    threads: int,
) -> tuple[Float, Float]:
    a, b, moved = _packed(a), _packed(b), np.array(pixels, np.float32, order="C")
    if moved.shape != (*a.shape[:-1], 2) or a.shape[-1] != b.shape[-1]:
        raise ValueError("search takes a match for each descriptor, and descriptors of one length")
    score = np.empty(a.shape[:-1], np.float32)
    dilations = np.array(DILATIONS_PX, np.int32)
    height, width, d = b.shape
    given = _SearchDescriptors(
        a.ctypes.data, b.ctypes.data, width, height, score.size, d, dilations.ctypes.data,
        len(dilations), RADIUS, LEAST_CURVATURE, moved.ctypes.data, score.ctypes.data,
    )  # fmt: skip
    library.call("aq_search_descriptors", ctypes.byref(given), threads)
    return moved, score


def _packed(
    field: Array,  # [...]
) -> Float:
    return np.ascontiguousarray(field, dtype=np.float32)


# --------------------------------------------------------------------------------------------------
# Fields with holes.


def continued(
    field: Float,  # [h, w, C]
    known: Mask,  # [h, w]
) -> Float:
    """[h, w, C] with what is known; elsewhere the mean of what is known around, coarse to fine."""
    if known.all() or not known.any():
        return field if known.all() else np.zeros_like(field)
    filled = np.where(known[..., None], field, np.float32(0.0))
    if max(known.shape) <= 2:
        return np.where(known[..., None], field, filled.sum((0, 1)) / np.float32(known.sum()))
    size = (-(-known.shape[1] // 2), -(-known.shape[0] // 2))
    weight = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    total = cv2.resize(filled, size, interpolation=cv2.INTER_AREA)
    mean = np.asarray(total / np.maximum(weight, SHORTEST)[..., None], dtype=np.float32)
    coarse = continued(mean, np.asarray(weight > 0.01))
    around = np.asarray(cv2.resize(coarse, known.shape[::-1]), dtype=np.float32)
    return np.where(known[..., None], field, around)
