// What the numbers of /health mean, in words.

const GOOD = ["tracking"];
const BUSY = ["starting", "initialising", "idle", "paused", "finishing", "stopping"];
const DEVICE_GOOD = ["connected", "streaming", "recording"];

export function colourOf(state, ok) {
  if (GOOD.includes(state)) return "good";
  if (BUSY.includes(state)) return "busy";
  return ok ? "good" : "warn";
}

export const colourOfDevice = state => (DEVICE_GOOD.includes(state) ? "good" : "warn");

export const capital = text => text.charAt(0).toUpperCase() + text.slice(1);

export function ago(seconds) {
  if (seconds < 90) return `${Math.round(seconds)} s ago`;
  return seconds < 5400 ? `${Math.round(seconds / 60)} min ago` : `${(seconds / 3600).toFixed(1)} h ago`;
}

const number = (value, digits) => (value === null || value === undefined ? "–" : value.toFixed(digits));
const count = value => Number(value ?? 0).toLocaleString("en");

// The youngest value of a kind that any source reports.
function newest(telemetry, kind) {
  const found = Object.values(telemetry ?? {}).map(kinds => kinds[kind]).filter(Boolean);
  return found.sort((a, b) => a.age_s - b.age_s)[0];
}

function measured(telemetry, kind, digits, pick = value => value) {
  const found = newest(telemetry, kind);
  if (!found) return null;
  const old = found.age_s > 3 ? `, ${ago(found.age_s)}` : "";
  const unit = found.unit.startsWith("deg") ? "°" : ` ${found.unit}`;
  return number(pick(found.value), digits) + unit + old;
}

const known = rows => rows.filter(([, value]) => value !== null);

export function factsNow(report) {
  const lag = report.lag_ms ?? {};
  return known([
    ["Depth", measured(report.telemetry, "depth", 2)],
    ["Altitude", measured(report.telemetry, "altitude", 2)],
    ["Heading", measured(report.telemetry, "attitude", 0, value => Math.round(value[2]) % 360)],
    ["Frame rate", `${number(report.fps, 1)} per second`],
    ["Lag", `${number(lag.p50, 0)} ms, 95 %: ${number(lag.p95, 0)} ms`],
    ["Gaussians", count(report.gaussians)],
    ["Keyframes", count(report.keyframes)],
    ["Service", report.level ?? null],
  ]);
}

function length(frame) {
  if (!frame.metric) return `no metres: ${frame.scale_source.replace(/^none: /, "")}`;
  return `metres ± ${(100 * frame.scale_sigma).toFixed(1)} %, from ${frame.scale_source}`;
}

export function factsOfScale(report) {
  const frame = report.metric_frame;
  if (!frame) return [["Lengths", "–"]];
  const tilt = frame.level ? `level ± ${number(frame.gravity_sigma_deg, 1)}°` : "not level: gravity unknown";
  const unused = Object.entries(frame.sources ?? {})
    .filter(([, source]) => source.reason)
    .map(([name, source]) => [name, source.reason]);
  return [["Lengths", length(frame)], ["Vertical", tilt], ["Axes", `x to ${frame.north}`], ...unused];
}

const CLASSES = [["well", "seen well"], ["sparse", "seen sparsely"], ["too_far", "too far for this water"]];

// Name of the class, its words and its area.
export function coverageKey({ areas }, unit) {
  const square = unit === "m" ? " m²" : "";
  return CLASSES.map(([name, words]) => [name, `${words}: ${Number((areas[name] ?? 0).toPrecision(3))}${square}`]);
}

export function coverageNote({ overlap, swath, next_line: next, range_limit: limit }, unit) {
  const said = [];
  if (overlap !== null && overlap >= 0) said.push(`overlap to the last line ${Math.round(100 * overlap)} %`);
  if (overlap !== null && overlap < 0) said.push(`gap to the last line ${number(-overlap * swath, 1)} ${unit}`);
  if (next) said.push(`next line (dashed): ${Math.round(100 * next.new_share)} % new`);
  if (limit !== null) said.push(`this water allows ${number(limit, 1)} ${unit}`);
  return capital(said.join("; "));
}

// Every number of the report as rows of a table.
export function flat(value, name = "") {
  if (value === null || typeof value !== "object") return [[name, String(value)]];
  if (Array.isArray(value)) return [[name, value.map(each => JSON.stringify(each)).join(", ")]];
  return Object.entries(value).flatMap(([key, inner]) =>
    flat(inner, (name ? `${name}, ` : "") + key.replaceAll("_", " ")));
}
