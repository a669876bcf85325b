// Constants of the splatting model, mirrored in aquaflow/render/limits.py; a test compares the
// two.
#pragma once

namespace aq {

constexpr float kDilationPx2 = 0.3f;        // low-pass filter of EWA splatting, added to V'
constexpr float kMaxAlpha = 0.99f;          // keeps 1 / (1 - alpha) finite
constexpr float kMinAlpha = 1.0f / 255.0f;  // one grey level: smaller contributions are dropped
constexpr float kMinTransmittance = 1e-4f;  // a pixel takes contributions while T is above this
constexpr float kNearPlane = 0.05f;         // metres, along the optical axis
constexpr float kTangentMargin = 0.3f;  // half fields of view outside the image where J is clamped
constexpr float kMinQuatNormSq = 1e-24f;  // shorter quaternions have no direction
constexpr float kMaxSigmaPx = 1e5f;       // keeps det(V') inside float32
constexpr float kRadiusSigmas = 3.0f;     // reported radius
constexpr int kTile = 16;                 // pixels; 8 is a third slower, 32 needs more mask bits

constexpr int kSsimWindow = 11;
constexpr double kSsimSigma = 1.5;
constexpr float kSsimC1 = 1e-4f;  // (0.01 * 1)^2
constexpr float kSsimC2 = 9e-4f;  // (0.03 * 1)^2

constexpr float kLog2e = 1.4426950408889634f;
constexpr float kLn2 = 0.6931471805599453f;
constexpr float kLog2MinAlpha = -7.99435343685886f;  // log2(1 / 255)

}  // namespace aq
