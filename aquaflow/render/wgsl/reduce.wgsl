// Sums of a table's columns: a workgroup for each column of vectors.

@group(0) @binding(0) var<uniform> shape: vec4u;  // rows; columns; first place in the results
@group(0) @binding(1) var<storage, read> table: array<vec4f>;  // [rows, columns]
@group(0) @binding(2) var<storage, read_write> results: array<vec4f>;

@compute @workgroup_size(256)
fn reduce(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) thread: u32) {
  var own = vec4f(0);
  for (var row = thread; row < shape.x; row += 256) { own += table[row * shape.y + group.x]; }
  let total = add_up(thread, own);
  if (thread == 0) { results[shape.z + group.x] = total; }
}
