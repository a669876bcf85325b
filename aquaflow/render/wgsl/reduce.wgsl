// Sums of a table's columns: a workgroup for each column of vectors.

@group(0) @binding(0) var<uniform> shape: vec4u;  // rows; columns; first place in the results
@group(0) @binding(1) var<storage, read> table: array<vec4f>;  // [rows, columns]
@group(0) @binding(2) var<storage, read_write> results: array<vec4f>;

var<workgroup> sums: array<vec4f, 256>;

@compute @workgroup_size(256)
fn reduce(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) thread: u32) {
  var own = vec4f(0);
  for (var row = thread; row < shape.x; row += 256) { own += table[row * shape.y + group.x]; }
  sums[thread] = own;
  for (var half = 128u; half > 0; half /= 2) {
    workgroupBarrier();
    if (thread < half) { sums[thread] += sums[thread + half]; }
  }
  if (thread == 0) { results[shape.z + group.x] = sums[0]; }
}
