// The GPU's shaders: points and their colours, rings on the ground, shading by depth.
"use strict";

const MODES = ["class", "error", "uncertainty", "height", "intensity"];
const ONLY = ["all", "wrong", "uncertain"];

const POINT_SHADER = `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 1) in float intensity;
layout(location = 2) in float disagreement;
layout(location = 3) in uint label;
layout(location = 4) in uint truth;
layout(location = 5) in uint uncertain;
uniform mat4 matrix;
uniform vec3 center, unit, low, high;  // low, high: the corners of the box
uniform vec2 range;
uniform vec3 correct, wrong, unscored;
uniform float size, smallest;
uniform int mode, only;
uniform sampler2D classes;  // the colour of each class; its alpha is 0 if the class is hidden
uniform sampler2D ramp;
flat out vec3 color;

vec3 ramped(float value) {
  float place = clamp((value - range.x) / max(range.y - range.x, 1e-6), 0.0, 1.0);
  return texture(ramp, vec2((place * 255.0 + 0.5) / 256.0, 0.5)).rgb;
}

void main() {
  vec3 at = center + unit * position;
  vec4 own = texelFetch(classes, ivec2(int(label), 0), 0);
  bool scored = truth > 0u, missed = scored && label != truth, doubted = uncertain > 0u;
  color = own.rgb;
  if (mode == 1) color = missed ? wrong : scored ? correct : unscored;
  if (mode == 2) color = ramped(disagreement);
  if (mode == 3) color = ramped(at.z);
  if (mode == 4) color = ramped(intensity);
  bool inside = all(greaterThanEqual(at, low)) && all(lessThanEqual(at, high));
  bool shown = inside && own.a > 0.5 && (only == 0 || (only == 1 && missed) || (only == 2 && doubted));
  gl_Position = shown ? matrix * vec4(at, 1.0) : vec4(0.0, 0.0, 2.0, 1.0);
  // Laser beams diverge. Points far from the sensor are drawn larger, so that surfaces have no gaps.
  float metres = 0.055 + 0.002 * length(at);
  bool stressed = (mode == 1 && missed) || (mode == 2 && doubted);
  gl_PointSize = clamp(size * metres / gl_Position.w, smallest, 40.0) * (stressed ? 1.4 : 1.0);
}`;

const POINT_COLOR = `#version 300 es
precision mediump float;
flat in vec3 color;
out vec4 painted;
void main() {
  vec2 off = gl_PointCoord - 0.5;
  if (dot(off, off) > 0.25) discard;
  painted = vec4(color, 1.0);
}`;

const RING_SHADER = `#version 300 es
layout(location = 0) in vec3 position;
uniform mat4 matrix;
void main() { gl_Position = matrix * vec4(position, 1.0); }`;

const RING_COLOR = `#version 300 es
precision mediump float;
uniform float strength;
out vec4 painted;
void main() { painted = vec4(strength); }`;

const SCREEN_SHADER = `#version 300 es
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0); }`;

// Eye-dome lighting darkens points next to nearer points, which shows edges and depth without normals.
const SCREEN_COLOR = `#version 300 es
precision highp float;
uniform sampler2D colors;
uniform highp sampler2D depths;
uniform float near, far, strength, reach;
out vec4 painted;

// The reciprocal of the distance, times 2 near far.
float nearness(ivec2 pixel) {
  float depth = texelFetch(depths, clamp(pixel, ivec2(0), textureSize(depths, 0) - 1), 0).r;
  return far + near - (2.0 * depth - 1.0) * (far - near);
}

float hidden_by(ivec2 beside, float own) {
  return clamp(log2(nearness(beside) / own) - 0.01, 0.0, 0.6);
}

void main() {
  ivec2 pixel = ivec2(gl_FragCoord.xy);
  vec4 color = texelFetch(colors, pixel, 0);
  if (color.a == 0.0) discard;
  float own = nearness(pixel), hidden = 0.0;
  int straight = int(round(reach)), oblique = int(round(0.7071068 * reach));
  ivec2 right = ivec2(straight, 0), up = ivec2(0, straight), rising = ivec2(oblique), falling = ivec2(oblique, -oblique);
  hidden += hidden_by(pixel + right, own) + hidden_by(pixel - right, own);
  hidden += hidden_by(pixel + up, own) + hidden_by(pixel - up, own);
  hidden += hidden_by(pixel + rising, own) + hidden_by(pixel - rising, own);
  hidden += hidden_by(pixel + falling, own) + hidden_by(pixel - falling, own);
  painted = vec4(color.rgb * max(exp(-strength * hidden), 0.25), 1.0);
}`;
