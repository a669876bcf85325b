// AquaFlow's CPU kernels behind a plain C ABI: Gaussian rasteriser, L1 + SSIM, selective Adam, and
// the dense parts of tracking.
//
// No torch or Python headers: the library serves every version of both. All arrays are contiguous,
// in row-major order, and float32 where nothing else is said. Functions return 0, or 1 when memory
// ran out.
#include <algorithm>
#include <cstdint>
#include <new>
#include <stdexcept>

#include "activate.h"
#include "adam.h"
#include "anchor_equations.h"
#include "blend.h"
#include "check_flow.h"
#include "constants.h"
#include "context.h"
#include "decode_view.h"
#include "decode_view_backward.h"
#include "fuse_depths.h"
#include "fuse_ranges.h"
#include "image_formation.h"
#include "match_points.h"
#include "photometric.h"
#include "pool.h"
#include "pose_equations.h"
#include "project.h"
#include "project_backward.h"
#include "refine_flow.h"
#include "see_places.h"
#include "tiles.h"
#include "view_loss.h"

#ifndef AQ_SOURCE_HASH
#error "build with aquaflow/render/native/build.py, which passes AQ_SOURCE_HASH"
#endif

#define AQ_EXPORT __attribute__((visibility("default")))

using namespace aq;

template <class Work>
static int guarded(const Work& work) {
  try {
    work();
    return 0;
  } catch (const std::bad_alloc&) {
    return 1;
  } catch (const std::length_error&) {
    return 1;
  }
}

static Camera make_camera(const float* viewmat, const float* intrinsics, int width, int height) {
  Camera cam;
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) cam.w[i][j] = viewmat[4 * i + j];
    cam.d[i] = viewmat[4 * i + 3];
  }
  cam.fx = intrinsics[0], cam.fy = intrinsics[1], cam.cx = intrinsics[2], cam.cy = intrinsics[3];
  cam.width = width, cam.height = height;
  const float margin_x = kTangentMargin * 0.5f * (float)width / cam.fx;
  const float margin_y = kTangentMargin * 0.5f * (float)height / cam.fy;
  cam.tan_x_min = -cam.cx / cam.fx - margin_x;
  cam.tan_x_max = ((float)width - cam.cx) / cam.fx + margin_x;
  cam.tan_y_min = -cam.cy / cam.fy - margin_y;
  cam.tan_y_max = ((float)height - cam.cy) / cam.fy + margin_y;
  return cam;
}

extern "C" {

// Searched for in the file before it is loaded, to see whether it was built from these sources.
AQ_EXPORT extern const char aq_source_hash[];
__attribute__((used)) const char aq_source_hash[] = "aquaflow-source:" AQ_SOURCE_HASH;

// Mirrored by limits.py; order as in library.py.
AQ_EXPORT void aq_constants(double* out) {
  const double all[] = {kDilationPx2,   kMaxAlpha,      kMinAlpha,   kMinTransmittance, kNearPlane,
                        kTangentMargin, kMinQuatNormSq, kMaxSigmaPx, kRadiusSigmas,     kTile};
  for (double value : all) *out++ = value;
}

AQ_EXPORT void* aq_context_new() { return new (std::nothrow) Context(); }
AQ_EXPORT void aq_context_free(void* context) { delete static_cast<Context*>(context); }

// viewmat [4, 4] world -> camera; intrinsics [4] fx fy cx cy, pixel centres at half-integers;
// active [tiles_y, tiles_x] tiles to draw, or null for all.
AQ_EXPORT int aq_forward(void* context, int count, int channels, int width, int height, int threads,
                         const float* means, const float* quats, const float* scales,
                         const float* opacities, const float* colours, const float* viewmat,
                         const float* intrinsics, float* image, float* alpha, uint8_t* visible,
                         float* radius_px, const uint8_t* active) {
  return guarded([&] {
    Context& ctx = *static_cast<Context*>(context);
    ctx.count = count, ctx.channels = channels;
    ctx.threads = std::min(std::max(threads, 1), kMaxThreads);
    ctx.camera = make_camera(viewmat, intrinsics, width, height);
    ctx.tiles_x = (width + kTile - 1) / kTile, ctx.tiles_y = (height + kTile - 1) / kTile;
    ctx.active.set(active, ctx.tiles_x, ctx.tiles_y);
    std::fill_n(ctx.stage_ms, (int)kStages, 0.0);
    const GaussianInputs in{means, quats, scales, opacities, colours};
    ctx.timed(kProject, [&] { project(ctx, in, visible, radius_px); });
    ctx.timed(kTileLists, [&] { build_tile_lists(ctx); });
    ctx.timed(kBlend,
              [&] { channels == 3 ? blend<3>(ctx, image, alpha) : blend<4>(ctx, image, alpha); });
  });
}

// Needs the inputs and the image of the forward pass that the context belongs to. g_viewmat [4, 4].
AQ_EXPORT int aq_backward(void* context, const float* means, const float* quats,
                          const float* scales, const float* opacities, const float* colours,
                          const float* image, const float* g_image, const float* g_alpha,
                          float* g_means, float* g_quats, float* g_scales, float* g_opacities,
                          float* g_colours, float* g_viewmat) {
  return guarded([&] {
    Context& ctx = *static_cast<Context*>(context);
    const GaussianGradients out{g_means, g_quats, g_scales, g_opacities, g_colours};
    if (ctx.visible == 0) {  // also the way out for a camera that is not finite
      std::fill(g_viewmat, g_viewmat + 16, 0.0f);
      clear_gradients(ctx, out);
      return;
    }
    const ImageGradients pixels{image, g_image, g_alpha};
    const GaussianInputs in{means, quats, scales, opacities, colours};
    const float* gradient = nullptr;
    ctx.timed(kBlendBackward, [&] {
      gradient =
          ctx.channels == 3 ? blend_backward<3>(ctx, pixels) : blend_backward<4>(ctx, pixels);
    });
    ctx.timed(kProjectBackward, [&] { project_backward(ctx, in, gradient, out, g_viewmat); });
  });
}

// [5] milliseconds of the context's last passes, by Stage; backward's are zero where it has not
// run.
AQ_EXPORT void aq_stage_ms(void* context, double* out) {
  std::copy_n(static_cast<const Context*>(context)->stage_ms, (int)kStages, out);
}

// See photometric.h. g_rendered may be null when no gradient is wanted.
AQ_EXPORT int aq_photometric(const float* rendered, const float* target, const float* weight,
                             const float* mask, int width, int height, float ssim_weight,
                             int threads, float* loss, float* g_rendered) {
  return guarded([&] {
    *loss = photometric({rendered, target, weight, mask, width, height, ssim_weight},
                        std::min(std::max(threads, 1), kMaxThreads), g_rendered);
  });
}

// See view_loss.h: rendered and target [P, 3], weight [P] give mask [P].
AQ_EXPORT int aq_outlier_mask(const float* rendered, const float* target, const float* weight,
                              float tau, int pixels, int threads, uint8_t* mask) {
  return guarded([&] {
    outlier_mask(rendered, target, weight, tau, pixels, std::min(std::max(threads, 1), kMaxThreads),
                 mask);
  });
}

// See view_loss.h: maps [P] give the loss and its derivative by z [P].
AQ_EXPORT int aq_range_loss(const float* z, const float* alpha, const float* inverse_range,
                            const float* weight, float min_range, int pixels, int threads,
                            float* loss, float* g_z) {
  return guarded([&] {
    *loss = range_loss({z, alpha, inverse_range, weight, min_range, pixels},
                       std::min(std::max(threads, 1), kMaxThreads), g_z);
  });
}

// See image_formation.h: drawn [P, 4], alpha [P] and water [15] give image [P, 3] and range [P].
AQ_EXPORT int aq_compose_water(const float* drawn, const float* alpha, const float* water,
                               const float* uneven, const float* gain, int pixels, int threads,
                               float* image, float* range) {
  return guarded([&] {
    compose_water({drawn, alpha, water, uneven, gain, pixels},
                  std::min(std::max(threads, 1), kMaxThreads), image, range);
  });
}

AQ_EXPORT int aq_compose_water_backward(const float* drawn, const float* alpha, const float* water,
                                        const float* uneven, const float* gain, int pixels,
                                        int threads, const float* g_image, const float* g_range,
                                        float* g_drawn, float* g_alpha, float* g_water) {
  return guarded([&] {
    compose_water_backward({drawn, alpha, water, uneven, gain, pixels},
                           std::min(std::max(threads, 1), kMaxThreads), g_image, g_range, g_drawn,
                           g_alpha, g_water);
  });
}

// See activate.h: the raw parameters of ``count`` Gaussians give what is drawn of them.
AQ_EXPORT int aq_activate(const float* means, const float* log_scales, const float* opacity_logits,
                          const float* raw_colours, const float* centre, int count, int threads,
                          float* scales, float* opacities, float* colours) {
  return guarded([&] {
    activate({means, log_scales, opacity_logits, raw_colours, centre, count},
             std::min(std::max(threads, 1), kMaxThreads), scales, opacities, colours);
  });
}

AQ_EXPORT int aq_activate_backward(const float* means, const float* log_scales,
                                   const float* opacity_logits, const float* raw_colours,
                                   const float* centre, int count, int threads, const float* scales,
                                   const float* colours, const float* g_scales,
                                   const float* g_opacities, const float* g_colours, float* g_means,
                                   float* g_log_scales, float* g_opacity_logits,
                                   float* g_raw_colours) {
  return guarded([&] {
    activate_backward(
        {means, log_scales, opacity_logits, raw_colours, centre, count},
        std::min(std::max(threads, 1), kMaxThreads), scales, colours,
        {g_scales, g_opacities, g_colours, g_means, g_log_scales, g_opacity_logits, g_raw_colours});
  });
}

// See decode_view.h: the attributes come in as the initial ones.
AQ_EXPORT int aq_decode_view(const DecoderView* in, int threads, float* quats, float* log_scales,
                             float* raw_colours) {
  return guarded([&] {
    decode_view(*in, std::min(std::max(threads, 1), kMaxThreads), quats, log_scales, raw_colours);
  });
}

AQ_EXPORT int aq_decode_view_backward(const DecoderView* in, int threads,
                                      const DecoderGradients* out) {
  return guarded(
      [&] { decode_view_backward(*in, std::min(std::max(threads, 1), kMaxThreads), *out); });
}

// See refine_flow.h: the flow [H, W, 2] from a to b, moved to where b fits best.
AQ_EXPORT int aq_refine_flow(const uint8_t* a, const uint8_t* b, const float* flow, int width,
                             int height, const float* contrast, int contrast_radius,
                             const float* window, int window_radius, float grey_noise,
                             float most_step_px, float singular, float* out) {
  return guarded([&] {
    static thread_local FlowRefiner refiner;  // its planes are as large as the pictures
    refiner.run({a,
                 b,
                 flow,
                 {width, height},
                 {contrast, contrast_radius},
                 {window, window_radius},
                 grey_noise,
                 most_step_px,
                 singular},
                out);
  });
}

// See check_flow.h: error [H, W] and valid [H, W] of a flow there and back.
AQ_EXPORT int aq_check_flow(const float* forward, const float* backward, const float* texture_a,
                            const float* texture_b, int width, int height, float border_px,
                            float most_error_px, float least_texture, float* error,
                            uint8_t* valid) {
  check_flow({forward, backward, texture_a, texture_b, border_px, most_error_px, least_texture},
             {width, height}, error, valid);
  return 0;
}

// See match_points.h: pixels [count, 2] whose rays are nearest to the wanted ones.
AQ_EXPORT int aq_project_rays(const ProjectRays* in, int threads) {
  return guarded(
      [&] { for_each_match(*in, std::min(std::max(threads, 1), kMaxThreads), project_ray); });
}

// See match_points.h: pixels [count, 2] moved to where descriptors agree most.
AQ_EXPORT int aq_search_descriptors(const SearchDescriptors* in, int threads) {
  return guarded(
      [&] { for_each_match(*in, std::min(std::max(threads, 1), kMaxThreads), search_descriptor); });
}

// See fuse_depths.h. Returns the number of pixels with a usable measurement.
AQ_EXPORT int aq_fuse_depths(const FuseDepths* in) { return fuse_depths(*in); }

// See fuse_ranges.h: distances of places from the surface that one view shows.
AQ_EXPORT int aq_fuse_ranges(const FuseRanges* in) {
  fuse_ranges(*in);
  return 0;
}

// See see_places.h: colours of places, and how well they are known, from what one view shows.
AQ_EXPORT int aq_add_colours(const SeePlaces* in, const PlaceColours* out) {
  add_colours(*in, *out);
  return 0;
}

AQ_EXPORT int aq_add_information(const SeePlaces* in, const PlaceInformation* out) {
  add_information(*in, *out);
  return 0;
}

// See pose_equations.h: cost and normal equations, and, unless ``left`` is null, what is left.
AQ_EXPORT int aq_pose_equations(const PoseEquations* in, PoseResult* out, const PoseLeft* left) {
  pose_equations(*in, *out, left);
  return 0;
}

// See anchor_equations.h: lengths [views, points] of what is left of an anchor's matches.
AQ_EXPORT int aq_anchor_errors(const AnchorProblem* in, double* length) {
  anchor_errors(*in, length);
  return 0;
}

// See anchor_equations.h: an anchor's part of the normal equations, its depths eliminated.
AQ_EXPORT int aq_anchor_equations(const AnchorProblem* in, const AnchorSums* out) {
  return guarded([&] { anchor_equations(*in, *out); });
}

// See adam.h. Returns the number of visible rows skipped for a non-finite gradient.
AQ_EXPORT int aq_adam_step(int groups, const AdamGroup* group, int rows, const uint8_t* visible,
                           int32_t* steps, double beta1, double beta2, float eps, const float* bias,
                           int bias_rows, int threads) {
  return adam_step({groups, group, rows, visible, steps, beta1, beta2, eps, bias, bias_rows},
                   std::min(std::max(threads, 1), kMaxThreads));
}

}  // extern "C"
