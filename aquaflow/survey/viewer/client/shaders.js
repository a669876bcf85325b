// Gaussians as ellipses on the screen (M. Zwicker et al., EWA Splatting, 2002; B. Kerbl et al., 3D
// Gaussian Splatting, 2023), each through the water before it (paper, Eq. 12 and 15).

export const VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D;
uniform usampler2D data; uniform sampler2D palette;
uniform mat3 axes; uniform vec3 place; uniform vec2 focal, centre, size;
uniform vec2 logScales; uniform float brightest, grown, nearest;
uniform vec3 beta, Binf, b, Bres, d, gain, white, lamp; uniform float water, through, compression, shownCompression;
uniform int level, rangeLevel; uniform float within; uniform vec3 low, high;
in vec2 corner; in uint index;
out vec4 colour; out vec2 at;

vec4 bytes(uint word) { return vec4(uvec4(word, word >> 8, word >> 16, word >> 24) & 255u); }

mat3 rotation(vec4 q) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

// Highlights drawn together, or with -c apart again (aquaflow/water/tone.py).
vec3 toned(vec3 bright, float c) {
  vec3 above = max(bright - 0.8, 0.0);
  return min(bright, 0.8) + above / max(1.0 + c * above, 0.02);
}

// lamp: share of the light, power and range (aquaflow/water/mounting.py); its light comes as the water does.
vec3 throughWater(vec3 clear, float range) {
  float far = min(range, through), z = far * water;
  vec3 T = exp(-beta * z);
  vec3 beam = lamp.x * pow(lamp.z / max(far, 0.1 * lamp.z), lamp.y) * T;
  vec3 seen = T * (1.0 + water * (beam - lamp.x));
  vec3 veil = Binf * (1.0 - exp(-b * z)) + water * Bres * exp(-d * z);
  vec3 restored = toned(clear, -compression) * pow(white, vec3(1.0 - water)) * pow(gain, vec3(-water));
  return toned(restored * seen + veil, shownCompression * (1.0 - water));
}

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  ivec2 texel = ivec2(int(index & 1023u) * 2, int(index >> 10));
  uvec4 one = texelFetch(data, texel, 0), two = texelFetch(data, texel + ivec2(1, 0), 0);
  vec4 levels = vec4(bytes(one.w).yzw, 0.0);
  if (rangeLevel >= 0 && levels[rangeLevel] > within) return;
  vec3 p = uintBitsToFloat(two.yzw);
  if (any(lessThan(p, low)) || any(greaterThan(p, high))) return;
  vec3 t = transpose(axes) * (p - place);
  if (t.z < nearest) return;
  vec2 limit = 1.3 * size / (2.0 * focal);
  vec2 slope = clamp(t.xy / t.z, -limit, limit);
  vec4 first = bytes(one.y), second = bytes(one.z);
  vec3 scale = exp(logScales.x + vec3(first.zw, second.x) / 255.0 * (logScales.y - logScales.x)) * grown;
  vec4 q = (vec4(ivec4(int(two.x) << 24, int(two.x) << 16, int(two.x) << 8, int(two.x)) >> 24)) / 127.0;
  mat3 M = transpose(axes) * rotation(normalize(q));
  M = mat3(M[0] * scale.x, M[1] * scale.y, M[2] * scale.z);
  vec3 jx = vec3(focal.x, 0.0, -focal.x * slope.x) / t.z, jy = vec3(0.0, focal.y, -focal.y * slope.y) / t.z;
  vec3 mx = jx * M, my = jy * M;
  vec3 normal = cross(mx, my);
  float xx = dot(mx, mx) + 0.3, xy = dot(mx, my), yy = dot(my, my) + 0.3;
  if (0.5 * (xx + yy) + length(vec2(0.5 * (xx - yy), xy)) >= 1e10) return; // MAX_SIGMA_PX of limits.py
  float det = dot(normal, normal) + 0.3 * (xx + yy - 0.3); // by Cauchy-Binet: no cancellation for needles
  float alpha = second.y / 255.0;
  float reach = sqrt(2.0 * log(max(255.0 * alpha, 1.0)));
  if (reach <= 0.0) return;
  at = corner * reach;
  vec2 px = sqrt(xx) * at.x * vec2(1.0, xy / xx) + vec2(0.0, sqrt(det / xx) * at.y); // by the covariance's root, as splats.wgsl
  vec2 pixel = centre + focal * t.xy / t.z + px;
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);
  vec3 clear = vec3(second.zw, bytes(one.w).x) / 255.0 * brightest;
  vec3 shown = level < 0 ? throughWater(clear, length(t))
    : texture(palette, vec2((levels[level] + 0.5) / 256.0, 0.5)).rgb * (0.75 + 0.25 * min(dot(clear, vec3(0.6)), 1.0));
  colour = vec4(clamp(shown, 0.0, 1.0), alpha);
}`;

export const FRAGMENT = `#version 300 es
precision highp float;
in vec4 colour; in vec2 at;
out vec4 drawn;
void main() {
  float alpha = min(colour.a * exp(-0.5 * dot(at, at)), 0.99);
  if (alpha < 1.0 / 255.0) discard;
  drawn = vec4(colour.rgb * alpha, alpha);
}`;
