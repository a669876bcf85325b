// What is drawn of the Gaussians' raw parameters, and the sum of their volumes. A row of raw parameters
// has the layout of a row of Gaussians: mean and logit, quaternion, log-scales, raw colours.

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> raw: array<vec4f>;
@group(0) @binding(2) var<storage, read_write> gaussians: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> volumes: array<vec4f>;  // [blocks]

fn softplus(x: vec3f) -> vec3f {
  let y = COLOUR_SHARPNESS * x;
  return (max(y, vec3f(0)) + log(1 + exp(-abs(y)))) / COLOUR_SHARPNESS;
}

@compute @workgroup_size(256)
fn activate(@builtin(global_invocation_id) id: vec3u, @builtin(workgroup_id) group: vec3u,
            @builtin(local_invocation_index) thread: u32) {
  let i = id.x;
  var volume = 0.0;
  if (i < step.size.w) {
    let mean = raw[4 * i]; let log_scale = raw[4 * i + 2].xyz;
    let opacity = 1 / (1 + exp(-mean.w));
    gaussians[4 * i] = vec4f(mean.xyz, opacity);
    gaussians[4 * i + 1] = raw[4 * i + 1];
    gaussians[4 * i + 2] = vec4f(exp(log_scale), 0);
    gaussians[4 * i + 3] = vec4f(softplus(raw[4 * i + 3].xyz), distance(mean.xyz, step.centre.xyz));
    volume = exp(log_scale.x + log_scale.y + log_scale.z);
  }
  let total = add_up(thread, vec4f(volume, 0, 0, 0));
  if (thread == 0) { volumes[group.x] = total; }
}
