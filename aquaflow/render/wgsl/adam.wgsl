// From gradients of what is drawn to those of the raw parameters, and Adam's step of the Gaussians that
// are visible, each at its own count of steps (adam.py). A step whose loss is not finite moves nothing.

struct Rates {
  learning: vec4f,  // of means, quaternions, log-scales, raw colours
  rest: vec4f,      // of logits; 1 - beta1; 1 - beta2; eps
  counts: vec4u,    // rows of the table of bias corrections; hits that there was room for
}

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<uniform> rates: Rates;
@group(0) @binding(2) var<storage, read_write> raw: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> first: array<vec4f>;  // moments; the gap holds the count of steps
@group(0) @binding(4) var<storage, read_write> second: array<vec4f>;
@group(0) @binding(5) var<storage, read> gradients: array<vec4f>;
@group(0) @binding(6) var<storage, read> radius_px: array<f32>;
@group(0) @binding(7) var<storage, read> bias: array<vec2f>;
@group(0) @binding(8) var<storage, read> results: array<vec4f>;  // [0] losses, [1] sum of volumes
@group(0) @binding(9) var<storage, read_write> state: array<atomic<u32>>;  // [0] hits, [1] rows left out

fn is_sound(x: vec4f) -> bool { return all_finite(x) && all(abs(x) < vec4f(LARGEST_GRADIENT)); }

fn moved(at: u32, g: vec4f, learning: vec4f, correction: vec2f) {
  let m = first[at] + rates.rest.y * (g - first[at]);
  let v = second[at] + rates.rest.z * (g * g - second[at]);
  first[at] = m;
  second[at] = v;
  raw[at] -= learning * correction.x * m / (sqrt(v) * correction.y + rates.rest.w);
}

@compute @workgroup_size(256)
fn adam(@builtin(global_invocation_id) id: vec3u) {
  let i = id.x;
  if (i >= step.size.w || radius_px[i] <= 0) { return; }
  let loss = results[0];
  if (atomicLoad(&state[0]) > rates.counts.y) { return; }
  if (!all_finite(vec4f(loss.xyz, results[1].x))) { return; }
  let mean = raw[4 * i]; let log_scale = raw[4 * i + 2].xyz; let colour = raw[4 * i + 3].xyz;
  let g0 = gradients[4 * i]; let g3 = gradients[4 * i + 3];
  let ray = mean.xyz - step.centre.xyz;
  let range = length(ray);
  var g_mean = g0.xyz;
  if (range > 0) { g_mean += g3.w / range * ray; }
  let e = exp(-abs(mean.w));
  let g_first = vec4f(g_mean, g0.w * e / ((1 + e) * (1 + e)));
  let g_quat = gradients[4 * i + 1];
  let volume = step.weights.z * exp(log_scale.x + log_scale.y + log_scale.z) / f32(step.size.w);
  let g_scale = vec4f(gradients[4 * i + 2].xyz * exp(log_scale) + volume, 0);
  let g_colour = vec4f(g3.xyz / (1 + exp(-COLOUR_SHARPNESS * colour)), 0);
  if (!(is_sound(g_first) && is_sound(g_quat) && is_sound(g_scale) && is_sound(g_colour))) {
    atomicAdd(&state[1], 1u);
    return;
  }
  let count = u32(first[4 * i + 2].w);
  let correction = bias[min(count, rates.counts.x - 1)];
  moved(4 * i, g_first, vec4f(rates.learning.xxx, rates.rest.x), correction);
  moved(4 * i + 1, g_quat, vec4f(rates.learning.y), correction);
  moved(4 * i + 2, g_scale, vec4f(rates.learning.zzz, 0), correction);
  moved(4 * i + 3, g_colour, vec4f(rates.learning.www, 0), correction);
  first[4 * i + 2].w = f32(count + 1);
}
