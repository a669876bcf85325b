// A map's Gaussians as a browser got them, turned into those of project.wgsl, with the colours that they
// show through the water before them (paper, Eq. 12 and 15); and a quad for each ellipse that it makes.

struct Side {
  place: vec3f, nearest: f32,  // the eye, and from which depth on something is shown; map units
  log_scales: vec2f, water: f32, through: f32,
  brightest: f32, grown: f32, level: f32, range_level: f32,  // whose colours are shown; negative: a picture's; whose values hide
  beta: vec3f, compression: f32,
  B_inf: vec3f, shown_compression: f32,
  b: vec3f, within: f32,  // what exceeds it in `range_level` is hidden; nothing where that is negative
  B_res: vec3f, count: f32,
  d: vec3f, first: f32,  // Gaussians that are shown have this number at least
  gain: vec3f, white: vec3f, lamp: vec3f,
  low: vec3f, high: vec3f,  // the box that is kept
  background: vec4f,
}

@group(0) @binding(0) var<uniform> side: Side;
@group(0) @binding(1) var<storage, read> words: array<vec4u>;  // two for each, as load.js packs them
@group(0) @binding(2) var<storage, read> palette: array<u32, 256>;
@group(0) @binding(3) var<storage, read_write> gaussians: array<vec4f>;
@group(0) @binding(4) var<uniform> camera: Camera;
@group(0) @binding(5) var<storage, read> splats: array<vec4f>;
@group(0) @binding(6) var<storage, read> order: array<u32>;  // from near to far
@group(0) @binding(7) var<storage, read> radius_px: array<f32>;

fn bytes(word: u32) -> vec4f { return vec4f((vec4u(word) >> vec4u(0, 8, 16, 24)) & vec4u(255)); }

// Highlights drawn together, or with -c apart again (aquaflow/water/tone.py).
fn toned(bright: vec3f, c: f32) -> vec3f {
  let above = max(bright - 0.8, vec3f(0));
  return min(bright, vec3f(0.8)) + above / max(1.0 + c * above, vec3f(0.02));
}

// lamp: share of the light, power and range (aquaflow/water/mounting.py); its light comes as the water does.
fn through_water(clear: vec3f, range: f32) -> vec3f {
  let far = min(range, side.through); let z = far * side.water;
  let T = exp(-side.beta * z);
  let beam = side.lamp.x * pow(side.lamp.z / max(far, 0.1 * side.lamp.z), side.lamp.y) * T;
  let seen = T * (1.0 + side.water * (beam - side.lamp.x));
  let veil = side.B_inf * (1.0 - exp(-side.b * z)) + side.water * side.B_res * exp(-side.d * z);
  let restored = toned(clear, -side.compression) * pow(side.white, vec3f(1.0 - side.water)) * pow(side.gain, vec3f(-side.water));
  return toned(restored * seen + veil, side.shown_compression * (1.0 - side.water));
}

// What project.wgsl gets is relative to the eye, in units in which the nearest shown is at its near plane.
@compute @workgroup_size(256)
fn unpack(@builtin(global_invocation_id) id: vec3u) {
  let i = id.x;
  if (i >= u32(side.count)) { return; }
  let one = words[2 * i]; let two = words[2 * i + 1];
  let first = bytes(one.y); let second = bytes(one.z); let third = bytes(one.w);
  let levels = array<f32, 3>(third.y, third.z, third.w);
  let p = bitcast<vec3f>(two.yzw);
  let far = side.range_level >= 0 && levels[u32(max(side.range_level, 0))] > side.within;
  let hidden = id.x < u32(side.first) || far || any(p < side.low) || any(p > side.high);
  let unit = NEAR_PLANE_M / side.nearest;
  let t = p - side.place;
  let scale = exp(side.log_scales.x + vec3f(first.zw, second.x) / 255.0 * (side.log_scales.y - side.log_scales.x));
  let clear = vec3f(second.zw, third.x) / 255.0 * side.brightest;
  var shown: vec3f;
  if (side.level < 0) { shown = through_water(clear, length(t)); } else {
    shown = unpack4x8unorm(palette[u32(levels[u32(side.level)])]).rgb * (0.75 + 0.25 * min(dot(clear, vec3f(0.6)), 1.0));
  }
  gaussians[VECTORS * i] = vec4f(unit * t, select(second.y / 255.0, 0.0, hidden));
  gaussians[VECTORS * i + 1] = vec4f(vec4i(vec4u(two.x) << vec4u(24, 16, 8, 0)) >> vec4u(24));
  gaussians[VECTORS * i + 2] = vec4f(unit * side.grown * scale, 0);
  gaussians[VECTORS * i + 3] = vec4f(clamp(shown, vec3f(0), vec3f(1)), 0);
}

fn corner(vertex: u32) -> vec2f { return 2 * vec2f(f32(vertex & 1), f32(vertex >> 1)) - 1; }

@vertex
fn background(@builtin(vertex_index) vertex: u32) -> @builtin(position) vec4f { return vec4f(corner(vertex), 0, 1); }

@fragment
fn background_colour() -> @location(0) vec4f { return side.background; }

struct Drawn {
  @builtin(position) place: vec4f,
  @location(0) colour: vec4f,
  @location(1) at: vec2f,  // from its middle, in standard deviations
}

// The quad that touches the ellipse of 1/255 of alpha: its sides are the columns of the covariance's root.
@vertex
fn ellipse(@builtin(vertex_index) vertex: u32, @builtin(instance_index) instance: u32) -> Drawn {
  let i = order[camera.counts.x - 1 - instance];
  if (radius_px[i] == 0) { return Drawn(vec4f(0, 0, 2, 1), vec4f(0), vec2f(0)); }
  let s0 = splats[VECTORS * i]; let s1 = splats[VECTORS * i + 1]; let slope = splats[VECTORS * i + 3].y;
  let reach = 2 * LN2 * max(s1.y - LOG2_MIN_ALPHA, 0.0);
  let c = s1.x / (-0.5 * LOG2E);
  let to = corner(vertex);
  let pixel = s0.xy + 0.5 + to.x * s1.z * vec2f(1, slope) + vec2f(0, to.y * sqrt(reach / c));
  let place = 2 * pixel / vec2f(camera.size.xy) - 1;
  return Drawn(vec4f(place.x, -place.y, 0, 1), vec4f(splats[VECTORS * i + 2].rgb, exp2(s1.y)), to * sqrt(reach));
}

@fragment
fn ellipse_colour(drawn: Drawn) -> @location(0) vec4f {
  let alpha = min(drawn.colour.a * exp(-0.5 * dot(drawn.at, drawn.at)), MAX_ALPHA);
  if (alpha < MIN_ALPHA) { discard; }
  return vec4f(drawn.colour.rgb * alpha, alpha);
}
