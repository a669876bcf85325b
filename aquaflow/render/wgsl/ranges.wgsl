// Where the hits of each tile begin among the sorted ones: [tiles + 1].

@group(0) @binding(0) var<uniform> camera: Camera;
@group(0) @binding(1) var<storage, read> total: array<u32>;  // [1] hits
@group(0) @binding(2) var<storage, read> tiles: array<u32>;  // of each hit, sorted
@group(0) @binding(3) var<storage, read_write> ranges: array<u32>;  // zero where there are no hits

@compute @workgroup_size(256)
fn find_ranges(@builtin(global_invocation_id) id: vec3u) {
  let k = id.x;
  let count = min(total[0], arrayLength(&tiles));
  if (k >= count) { return; }
  var first = 0u;
  if (k > 0) { first = tiles[k - 1] + 1; }
  for (var tile = first; tile <= tiles[k]; tile++) { ranges[tile] = k; }
  if (k == count - 1) {
    for (var tile = tiles[k] + 1; tile <= camera.size.z * camera.size.w; tile++) { ranges[tile] = count; }
  }
}
