// Which tiles a projected Gaussian reaches.

struct TileBox { first: vec2u, last: vec2u }

fn tile_of(pixel: vec2f, tiles: vec2u) -> vec2u {
  return vec2u(clamp(pixel / f32(TILE_PX), vec2f(0), vec2f(tiles - 1)));
}

// The tiles that the box around the ellipse touches.
fn tile_box(centre: vec2f, extent: vec2f, tiles: vec2u) -> TileBox {
  return TileBox(tile_of(centre - extent, tiles), tile_of(centre + extent, tiles));
}

const SLACK: f32 = 1e-4;  // the drawing loop takes the exponent in another order

// Whether alpha reaches MIN_ALPHA at a pixel centre of the tile's rectangle. The largest exponent
// over a rectangle lies at the nearest column or row, or where the conic is least along it.
fn reaches(tile: vec2u, s0: vec4f, s1: vec4f, slope: vec2f) -> bool {
  let low = vec2f(tile * TILE_PX) - s0.xy;
  let high = low + f32(TILE_PX - 1);
  let near = clamp(vec2f(0), low, high);
  let best = clamp(slope.yx * near.xy, low.yx, high.yx);  // y along the column, x along the row
  let column = (s0.z * near.x + s0.w * best.x) * near.x + s1.x * best.x * best.x;
  let row = (s0.z * best.y + s0.w * near.y) * best.y + s1.x * near.y * near.y;
  return max(column, row) > LOG2_MIN_ALPHA - s1.y - SLACK;
}
