// The sum over the 256 threads of a workgroup.

var<workgroup> sums: array<vec4f, 256>;

// All threads get it; may be called again at once.
fn add_up(thread: u32, own: vec4f) -> vec4f {
  sums[thread] = own;
  for (var half = 128u; half > 0; half /= 2) {
    workgroupBarrier();
    if (thread < half) { sums[thread] += sums[thread + half]; }
  }
  workgroupBarrier();
  let total = sums[0];
  workgroupBarrier();
  return total;
}
