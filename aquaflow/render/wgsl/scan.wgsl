// Sums over the 256 threads of a workgroup up to each of them.

var<workgroup> up_to: array<u32, 256>;

// The inclusive sum; may be called again at once.
fn scan(thread: u32, own: u32) -> u32 {
  up_to[thread] = own;
  for (var step = 1u; step < 256; step *= 2) {
    workgroupBarrier();
    var before = 0u;
    if (thread >= step) { before = up_to[thread - step]; }
    workgroupBarrier();
    up_to[thread] += before;
  }
  workgroupBarrier();
  return up_to[thread];
}
