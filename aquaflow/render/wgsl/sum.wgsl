// The exclusive sum of a table in place by one workgroup, and the table's total. The sizes that occur
// are thousands of numbers: one number for each block of a larger table.

@group(0) @binding(0) var<uniform> size: vec4u;  // [0] numbers
@group(0) @binding(1) var<storage, read_write> table: array<u32>;
@group(0) @binding(2) var<storage, read_write> total: array<u32>;

@compute @workgroup_size(256)
fn sum(@builtin(local_invocation_index) thread: u32) {
  let share = (size.x + 255) / 256;
  let first = min(thread * share, size.x);
  let end = min(first + share, size.x);
  var own = 0u;
  for (var k = first; k < end; k++) { own += table[k]; }
  let through = scan(thread, own);
  var next = through - own;
  for (var k = first; k < end; k++) {
    let here = table[k];
    table[k] = next;
    next += here;
  }
  if (thread == 255) { total[0] = through; }
}
