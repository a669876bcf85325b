// The hits: pairs of a tile and a Gaussian that reaches it. Gaussians are walked from near to far, and
// all hits of one lie side by side; a stable sort by tile then leaves each tile's from near to far.

@group(0) @binding(0) var<uniform> camera: Camera;
@group(0) @binding(1) var<storage, read> order: array<u32>;  // [N] Gaussians from near to far
@group(0) @binding(2) var<storage, read> splats: array<vec4f>;
@group(0) @binding(3) var<storage, read> hits: array<u32>;  // [N] of each Gaussian
@group(0) @binding(4) var<storage, read> drawn_tiles: array<u32>;
@group(0) @binding(5) var<storage, read_write> before: array<u32>;  // [blocks] hits of the blocks before
@group(0) @binding(6) var<storage, read_write> tiles: array<u32>;  // of each hit
@group(0) @binding(7) var<storage, read_write> owners: array<u32>;  // Gaussian of each hit
@group(0) @binding(8) var<storage, read_write> starts: array<u32>;  // [N] first hit of each Gaussian

fn hits_of(k: u32) -> u32 {
  var own = 0u;
  if (k < camera.counts.x) { own = hits[order[k]]; }
  return own;
}

@compute @workgroup_size(256)
fn count_hits(@builtin(global_invocation_id) id: vec3u, @builtin(workgroup_id) group: vec3u,
              @builtin(local_invocation_index) thread: u32) {
  let all = scan(thread, hits_of(id.x));
  if (thread == 255) { before[group.x] = all; }
}

@compute @workgroup_size(256)
fn list_hits(@builtin(global_invocation_id) id: vec3u, @builtin(workgroup_id) group: vec3u,
             @builtin(local_invocation_index) thread: u32) {
  let own = hits_of(id.x);
  let after = before[group.x] + scan(thread, own);
  if (id.x >= camera.counts.x || own == 0) { return; }
  let i = order[id.x];
  var next = after - own;
  starts[i] = next;
  let s0 = splats[VECTORS * i]; let s1 = splats[VECTORS * i + 1]; let s3 = splats[VECTORS * i + 3];
  let box = tile_box(s0.xy, s1.zw, camera.size.zw);
  for (var y = box.first.y; y <= box.last.y; y++) {
    for (var x = box.first.x; x <= box.last.x; x++) {
      let tile = y * camera.size.z + x;
      if (drawn_tiles[tile] == 0 || !reaches(vec2u(x, y), s0, s1, s3.xy)) { continue; }
      if (next >= arrayLength(&owners)) { return; }  // no room: the host sees the total, and draws again
      tiles[next] = tile;
      owners[next] = i;
      next++;
    }
  }
}
