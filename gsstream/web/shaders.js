// GLSL of the renderer. The conventions are those of the streams: 0.3 px blur, alpha cut 1/255, alpha clamp 0.999.

import { GEOMETRY_TEXELS, colourTexels } from "./texels.js";

const CONSTANTS = [
  "0.28209479177387814",
  "-0.4886025119029199 * y",
  "0.4886025119029199 * z",
  "-0.4886025119029199 * x",
  "1.0925484305920792 * x * y",
  "-1.0925484305920792 * y * z",
  "0.31539156525252005 * (2.0 * z * z - x * x - y * y)",
  "-1.0925484305920792 * x * z",
  "0.5462742152960396 * (x * x - y * y)",
  "-0.5900435899266435 * y * (3.0 * x * x - y * y)",
  "2.890611442640554 * x * y * z",
  "-0.4570457994644658 * y * (5.0 * z * z - 1.0)",
  "0.3731763325901154 * z * (5.0 * z * z - 3.0)",
  "-0.4570457994644658 * x * (5.0 * z * z - 1.0)",
  "1.445305721320277 * z * (x * x - y * y)",
  "-0.5900435899266435 * x * (x * x - 3.0 * y * y)",
];

function colourSum(degree) {
  const lane = (i) => `v[${i >> 2}].${"xyzw"[i & 3]}`;
  return CONSTANTS.slice(0, (degree + 1) ** 2)
    .map((basis, k) => `  sum += (${basis}) * vec3(${lane(3 * k)}, ${lane(3 * k + 1)}, ${lane(3 * k + 2)});`)
    .join("\n");
}

/** GLSL of `seenFromDEGREE(colours, direction, at, line)`: the colour from a direction, texels from `at` of a line. */
export function colourFunction(degree) {
  return `vec3 seenFrom${degree}(sampler2D colours, vec3 direction, int at, int line) {
  vec4 v[${colourTexels(degree)}];
  for (int i = 0; i < ${colourTexels(degree)}; i++) v[i] = texelFetch(colours, ivec2(at + i, line), 0);
  vec3 unit = direction / max(length(direction), 1e-10);
  float x = unit.x, y = unit.y, z = unit.z;
  vec3 sum = vec3(0.5);
${colourSum(degree)}
  return max(sum, 0.0);
}`;
}

/**
 * The fragment shader that projects: a pixel for each slot of the scene, for spherical harmonics of a degree. It writes
 * two textures: bits of the centre [2] and of the long half axis [2] in pixels; then bits of the short half axis's
 * length, of the opacity (0: not seen), and the colour as halves.
 */
export function projectionShader(degree) {
  return `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
const int TEXELS = ${colourTexels(degree)};
uniform sampler2D geometry;
uniform sampler2D colours;
uniform ivec2 lines;       // log2 of the Gaussians in one line of either texture
uniform mat3 rotation;     // world to camera
uniform vec3 translation;
uniform vec3 eye;
uniform vec4 intrinsics;   // fx, fy, cx, cy in pixels
uniform vec2 size;
uniform float near;
uniform float blur;        // pixels squared
uniform vec2 marking;      // frame shown, or -1 without marks; and how many frames a mark lasts
layout(location = 0) out uvec4 place;
layout(location = 1) out uvec4 look;

mat3 rotationOf(vec4 q) {
  q /= max(length(q), 1e-10);
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

${colourFunction(degree)}

vec3 marked(vec3 plain, float stamp) {
  if (marking.x < 0.0) return plain;
  float age = marking.x - stamp;
  float heat = stamp >= 0.0 && age >= 0.0 ? exp(-age / marking.y) : 0.0;
  vec3 grey = vec3(dot(plain, vec3(0.25, 0.5, 0.25))) * 0.45;
  return mix(grey, mix(vec3(0.9, 0.15, 0.1), vec3(1.0, 0.85, 0.2), heat), heat);
}

void main() {
  place = uvec4(0);
  look = uvec4(0);
  ivec2 slot = ivec2(gl_FragCoord.xy);
  ivec2 texel = ivec2(slot.x * ${GEOMETRY_TEXELS}, slot.y);
  vec4 first = texelFetch(geometry, texel, 0);
  float opacity = 1.0 / (1.0 + exp(-first.w));
  vec3 p = rotation * first.xyz + translation;
  if (!(p.z > near) || opacity < 1.0 / 255.0) return;
  vec4 third = texelFetch(geometry, texel + ivec2(2, 0), 0);
  vec2 focal = intrinsics.xy;
  vec2 center = focal * p.xy / p.z + intrinsics.zw;
  vec2 margin = 0.15 * size / focal;
  vec2 t = clamp(p.xy / p.z, -intrinsics.zw / focal - margin, (size - intrinsics.zw) / focal + margin);
  mat3 axes = rotation * rotationOf(texelFetch(geometry, texel + ivec2(1, 0), 0));
  vec3 spread = exp(third.xyz);
  vec3 depths = vec3(axes[0].z, axes[1].z, axes[2].z);
  vec3 across = focal.x / p.z * (vec3(axes[0].x, axes[1].x, axes[2].x) - t.x * depths) * spread;
  vec3 down = focal.y / p.z * (vec3(axes[0].y, axes[1].y, axes[2].y) - t.y * depths) * spread;
  float a = dot(across, across) + blur, b = dot(across, down), c = dot(down, down) + blur;
  float determinant = a * c - b * b;
  if (!(determinant > 0.0)) return;
  // As far as the opacity is above 1/255: what lies beside the picture need not be coloured.
  float reach = 2.0 * log(opacity * 255.0);
  vec2 extent = sqrt(reach * vec2(a, c)) + 1.0;
  if (any(lessThan(center + extent, vec2(0))) || any(greaterThan(center - extent, size))) return;
  float middle = 0.5 * (a + c), radius = length(vec2(0.5 * (a - c), b));
  float large = middle + radius, small = max(determinant / large, 0.0);
  vec2 along = abs(b) < 1e-9 * large ? (a >= c ? vec2(1, 0) : vec2(0, 1)) : normalize(vec2(b, large - a));
  int slots = slot.x + (slot.y << lines.x);
  int at = (slots & ((1 << lines.y) - 1)) * TEXELS;
  vec3 colour = marked(seenFrom${degree}(colours, first.xyz - eye, at, slots >> lines.y), third.w);
  colour = min(colour, 65504.0);
  place = floatBitsToUint(vec4(center, sqrt(large) * along));
  look = uvec4(
    floatBitsToUint(sqrt(small)), floatBitsToUint(opacity),
    packHalf2x16(colour.xy), packHalf2x16(vec2(colour.z, 0.0)));
}`;
}

/** One quad for each Gaussian, as far as it is seen. */
export const VERTEX_SHADER = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
uniform usampler2D places;
uniform usampler2D looks;
uniform usampler2D order;  // slots, farthest first
uniform ivec2 lines;       // log2 of the Gaussians in one line of the order, and of the other two
uniform vec2 size;
out vec2 away;             // from the centre, in half axes
flat out vec4 shade;       // colour, opacity

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  int turn = gl_VertexID >> 2;
  int s = int(texelFetch(order, ivec2(turn & ((1 << lines.x) - 1), turn >> lines.x), 0).x);
  ivec2 texel = ivec2(s & ((1 << lines.y) - 1), s >> lines.y);
  uvec4 look = texelFetch(looks, texel, 0);
  float opacity = uintBitsToFloat(look.y);
  if (opacity == 0.0) return;
  vec4 place = uintBitsToFloat(texelFetch(places, texel, 0));
  vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0;
  away = corner * (sqrt(2.0 * log(max(opacity * 255.0, 1.0))) + 0.005);
  vec2 across = vec2(-place.w, place.z) / length(place.zw) * uintBitsToFloat(look.x);
  vec2 point = (place.xy + away.x * place.zw + away.y * across) / size;
  gl_Position = vec4(2.0 * point.x - 1.0, 1.0 - 2.0 * point.y, 0.0, 1.0);
  shade = vec4(unpackHalf2x16(look.z), unpackHalf2x16(look.w).x, opacity);
}`;

export const FRAGMENT_SHADER = `#version 300 es
precision highp float;
in vec2 away;
flat in vec4 shade;
out vec4 result;

void main() {
  float alpha = min(shade.w * exp(-0.5 * dot(away, away)), 0.999);
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(shade.xyz * alpha, alpha);
}`;

export const COPY_VERTEX_SHADER = `#version 300 es
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`;

export const COPY_FRAGMENT_SHADER = `#version 300 es
precision highp float;
uniform sampler2D picture;
uniform ivec2 corner;  // of the window that is filled, in pixels of what it lies in
uniform float shown;   // share of the picture that is left of a fade into black
out vec4 result;

void main() {
  result = vec4(clamp(texelFetch(picture, ivec2(gl_FragCoord.xy) - corner, 0).rgb, 0.0, 1.0) * shown, 1.0);
}`;
