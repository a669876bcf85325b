// A stable radix sort of (key, value) by DIGIT_BITS at a time, and the exclusive sum that it needs.
// One pass: count() of every block of keys, sum() over digits and blocks, move() of every block.
// Stable, hence deterministic; no atomics and no subgroups, which not every adapter has.

const DIGIT_BITS: u32 = 4;
const DIGITS: u32 = 16;
const THREADS: u32 = 256;
const KEYS: u32 = 8;  // of each thread, one after the other
const BLOCK: u32 = THREADS * KEYS;
const PACKED: u32 = DIGITS / 2;  // two counts of 16 bits in a number: a block has 2048 keys

struct Pass { shift: u32, blocks: u32, first: u32 }

@group(0) @binding(0) var<uniform> turn: Pass;
@group(0) @binding(1) var<storage, read> total: array<u32>;  // [1] keys
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read> values: array<u32>;  // in the first pass: not read
@group(0) @binding(4) var<storage, read_write> counts: array<u32>;  // [DIGITS, blocks]
@group(0) @binding(5) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(6) var<storage, read_write> values_out: array<u32>;

var<workgroup> columns: array<array<u32, THREADS>, PACKED>;

// More hits than there is room for are not in the table; the host sees their number.
fn key_count() -> u32 { return min(total[0], arrayLength(&keys)); }
fn digit_of(key: u32) -> u32 { return (key >> turn.shift) & (DIGITS - 1); }
fn half_of(packed: u32, digit: u32) -> u32 { return (packed >> (16 * (digit & 1))) & 0xffff; }

// Counts of each digit among a thread's keys, then their inclusive sums over the block's threads.
fn count_block(block: u32, thread: u32) {
  for (var p = 0u; p < PACKED; p++) { columns[p][thread] = 0; }
  let first = block * BLOCK + thread * KEYS;
  for (var k = first; k < min(first + KEYS, key_count()); k++) {
    let digit = digit_of(keys[k]);
    columns[digit / 2][thread] += 1u << (16 * (digit & 1));
  }
  for (var step = 1u; step < THREADS; step *= 2) {
    shift_columns(thread, step, true);
  }
  workgroupBarrier();
}

// Every thread's counts become those of the thread ``step`` before it, or are added to its own.
fn shift_columns(thread: u32, step: u32, add: bool) {
  var before: array<u32, PACKED>;
  workgroupBarrier();
  for (var p = 0u; p < PACKED; p++) {
    before[p] = select(0u, columns[p][max(thread, step) - step], thread >= step);
  }
  workgroupBarrier();
  for (var p = 0u; p < PACKED; p++) {
    columns[p][thread] = select(0u, columns[p][thread], add) + before[p];
  }
}

@compute @workgroup_size(THREADS)
fn count(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) thread: u32) {
  count_block(group.x, thread);
  if (thread < DIGITS) {
    counts[thread * turn.blocks + group.x] = half_of(columns[thread / 2][THREADS - 1], thread);
  }
}

@compute @workgroup_size(THREADS)
fn move_keys(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) thread: u32) {
  count_block(group.x, thread);
  shift_columns(thread, 1u, false);  // from here on each thread has its column for itself
  let first = group.x * BLOCK + thread * KEYS;
  for (var k = first; k < min(first + KEYS, key_count()); k++) {
    let key = keys[k];
    let digit = digit_of(key);
    let to = counts[digit * turn.blocks + group.x] + half_of(columns[digit / 2][thread], digit);
    columns[digit / 2][thread] += 1u << (16 * (digit & 1));
    keys_out[to] = key;
    if (turn.first == 0) { values_out[to] = values[k]; } else { values_out[to] = k; }
  }
}
