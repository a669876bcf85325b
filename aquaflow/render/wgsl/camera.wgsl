// What all kernels of a drawing share: the camera, and which Gaussian has which numbers. The
// constants in capitals are written before this file by __init__.py, from limits.py.

struct Camera {
  rows: array<vec4f, 3>,  // world to camera: t = rows . (x, 1)
  lens: vec4f,            // fx fy cx cy, pixels
  tangents: vec4f,        // where the Jacobian's ray is clamped: least and most x / z, then y / z
  size: vec4u,            // width and height, pixels; columns and rows of tiles
  counts: vec4u,          // Gaussians in the first
}

// A Gaussian in four vectors: mean and opacity, quaternion wxyz, scales, colours. Its gradient has
// the same layout.
const VECTORS: u32 = 4;

// A projected Gaussian in four vectors: (u, v, qa, qb), (qc, log2 opacity, half size of its box),
// colours, (slopes -b/a and -b/c, conic a and b). log2 of alpha at the pixel (x, y) is
// qa dx^2 + qb dx dy + qc dy^2 + log2 opacity, with dx = x - u, dy = y - v and pixel centres at whole
// numbers.
