"""What is drawn of a Gaussian, in numbers that all renderers share; without torch, for the viewer's
page draws by them too."""

from __future__ import annotations

DILATION_PX2 = 0.3
"""Low-pass filter of EWA splatting: added to both variances of the projected covariance."""

MAX_ALPHA = 0.99
"""Clamp of one Gaussian's alpha; a clamped alpha has no gradient."""

MIN_ALPHA = 1.0 / 255.0
"""Contributions below one grey level are dropped."""

MIN_TRANSMITTANCE = 1e-4
"""A pixel takes contributions while its transmittance is above this."""

NEAR_PLANE_M = 0.05
"""Means closer than this along the optical axis are culled."""

TANGENT_MARGIN = 0.3
"""The projection's Jacobian is taken at most this many half fields of view outside the image."""

MIN_QUAT_NORM_SQ = 1e-24
"""Shorter quaternions have no direction: culled."""

MAX_SIGMA_PX = 1e5
"""Footprints wider than this along their long axis are culled: their determinant would leave
float32."""

TILE_PX = 16
"""Side of the square tiles that a picture is cut into, from its top left corner."""

RADIUS_SIGMAS = 3.0
"""``Rendering.radius_px`` is this many standard deviations along the ellipse's long axis."""
