// Fused photometric loss with its gradient:
//
//   (1 - l) mean(weight |M (rendered - target)|) + l (1 - mean(SSIM(M rendered, M target)))
//
// SSIM as Wang et al. 2004: 11 x 11 Gaussian window, sigma 1.5, images padded with zeros, mean over
// all pixels and channels. Images are [H, W, 3]: a horizontal tap is three floats away, so no plane
// is ever transposed. Rows stream through rings, two at a time, so intermediate maps stay in the
// core's cache.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

#include "constants.h"
#include "pool.h"
#include "row_ring.h"

namespace aq {

constexpr int kStrip = 256;  // floats of a row whose window sums are kept at a time

struct PhotometricInput {
  const float* rendered;  // [H, W, 3]
  const float* target;    // [H, W, 3]
  const float* weight;    // [H, W] on the L1 term
  const float* mask;      // [H, W], or null for all ones
  int width, height;
  float ssim_weight;
};

struct SsimTaps {
  float g[kSsimWindow];
  SsimTaps() {
    double total = 0, raw[kSsimWindow];
    for (int k = 0; k < kSsimWindow; k++) {
      const double d = k - kSsimRadius;
      total += raw[k] = std::exp(-d * d / (2 * kSsimSigma * kSsimSigma));
    }
    for (int k = 0; k < kSsimWindow; k++) g[k] = (float)(raw[k] / total);
  }
};

enum StatisticMap { kMeanX, kMeanY, kSquares, kProduct, kStatistics };
enum PartialMap { kDMean, kDVariance, kDCovariance, kPartials };

// Rows [first, last) of the image, computed by one thread.
class PhotometricBand {
 public:
  PhotometricBand(const PhotometricInput& in, double* row_loss, float* gradient)
      : in_(in), n_(kChannels * in.width),
        l1_scale_((float)((1.0 - in.ssim_weight) / ((double)n_ * in.height))),
        ssim_scale_((float)(in.ssim_weight / ((double)n_ * in.height))), row_loss_(row_loss),
        gradient_(gradient), weight_(n_), mask_(n_, 1.0f), masked_(n_), squares_(n_), product_(n_),
        blurred_(n_), partials_(n_), columns_(n_) {}

  void run(int first, int last) {
    for (int y = first - 2 * kSsimRadius; y < last + 2 * kSsimRadius; y += kRowsAtOnce) {
      for (int row = y; row < y + kRowsAtOnce; row++) blur_row(row);
      const int middle = y - kSsimRadius, done = middle - kSsimRadius;
      if (middle + kRowsAtOnce > first - kSsimRadius) ssim_rows(middle, first, last);
      if (done >= first) finish_rows(done, std::min(done + kRowsAtOnce, last));
    }
  }

 private:
  bool inside(int y) const { return y >= 0 && y < in_.height; }

  // One row of a per-pixel map, repeated for the channels.
  void spread(const float* per_pixel, int y, float* out) const {
    const float* row = per_pixel + (size_t)y * in_.width;
#pragma omp simd
    for (int p = 0; p < in_.width; p++)
      out[kChannels * p] = out[kChannels * p + 1] = out[kChannels * p + 2] = row[p];
  }

  void load_row(int y) {
    std::copy_n(in_.rendered + (size_t)y * n_, n_, masked_.row(y, 0));
    std::copy_n(in_.target + (size_t)y * n_, n_, masked_.row(y, 1));
    if (!in_.mask) return;
    spread(in_.mask, y, mask_.data());
    const float* mask = mask_.data();
    for (int image = 0; image < 2; image++) {
      float* row = masked_.row(y, image);
#pragma omp simd
      for (int i = 0; i < n_; i++) row[i] *= mask[i];
    }
  }

  // Horizontal window sums of x, y, x^2 + y^2 and x y.
  void blur_row(int y) {
    if (!inside(y)) return blurred_.clear(y);
    load_row(y);
    const float *x = masked_.row(y, 0), *t = masked_.row(y, 1);
    float *sq = squares_.row(0, 0), *xy = product_.row(0, 0);
    const SsimTaps taps = taps_;  // a local copy cannot alias the rows, so it stays in registers
#pragma omp simd
    for (int i = 0; i < n_; i++) {
      sq[i] = x[i] * x[i] + t[i] * t[i];
      xy[i] = x[i] * t[i];
    }
    const float* sources[kStatistics] = {x, t, sq, xy};
    for (int map = 0; map < kStatistics; map++) {
      const float* from = sources[map] - kSsimRadius * kChannels;
      float* to = blurred_.row(y, map);
#pragma omp simd
      for (int i = 0; i < n_; i++) {
        float total = 0;
#pragma GCC unroll 11
        for (int k = 0; k < kSsimWindow; k++) total += taps.g[k] * from[i + kChannels * k];
        to[i] = total;
      }
    }
  }

  // Vertical window sums of a ring's map for rows y and y + 1, floats [begin, begin + size).
  template <int Maps>
  void window_sums(RowRing<Maps>& ring, int map, int y, int begin, int size, float* first,
                   float* second) const {
    const float* rows[kSsimWindow + 1];
    for (int k = 0; k <= kSsimWindow; k++) rows[k] = ring.row(y + k - kSsimRadius, map) + begin;
    const SsimTaps taps = taps_;
#pragma omp simd
    for (int i = 0; i < size; i++) {
      float a = taps.g[0] * rows[0][i], b = taps.g[kSsimWindow - 1] * rows[kSsimWindow][i];
#pragma GCC unroll 10
      for (int k = 1; k < kSsimWindow; k++) {
        a += taps.g[k] * rows[k][i];
        b += taps.g[k - 1] * rows[k][i];
      }
      first[i] = a;
      second[i] = b;
    }
  }

  // SSIM of rows y and y + 1, and its derivatives; its sum counts in rows [first, last).
  void ssim_rows(int y, int first, int last) {
    double total[kRowsAtOnce] = {};
    for (int begin = 0; begin < n_; begin += kStrip) {
      const int size = std::min(kStrip, n_ - begin);
      float sums[kRowsAtOnce][kStatistics][kStrip];
      for (int map = 0; map < kStatistics; map++)
        window_sums(blurred_, map, y, begin, size, sums[0][map], sums[1][map]);
      for (int r = 0; r < kRowsAtOnce; r++) total[r] += ssim_strip(y + r, begin, size, sums[r]);
    }
    for (int r = 0; r < kRowsAtOnce; r++) {
      if (!inside(y + r)) partials_.clear(y + r);
      if (y + r >= first && y + r < last) row_loss_[y + r] += (double)ssim_scale_ * (n_ - total[r]);
    }
  }

  // SSIM summed over a strip, and its derivatives by mean, variance and covariance.
  float ssim_strip(int y, int begin, int size, const float (*sums)[kStrip]) {
    float *d_mean = partials_.row(y, kDMean) + begin, *d_var = partials_.row(y, kDVariance) + begin;
    float* d_cov = partials_.row(y, kDCovariance) + begin;
    float total = 0;
#pragma omp simd reduction(+ : total)
    for (int i = 0; i < size; i++) {
      const float mx = sums[kMeanX][i], my = sums[kMeanY][i], means_sq = mx * mx + my * my;
      const float a1 = 2 * mx * my + kSsimC1, a2 = 2 * (sums[kProduct][i] - mx * my) + kSsimC2;
      const float b1 = means_sq + kSsimC1, b2 = sums[kSquares][i] - means_sq + kSsimC2;
      const float inverse = 1.0f / (b1 * b2), ssim = a1 * a2 * inverse;
      total += ssim;
      const float by_var = -ssim * b1 * inverse, by_cov = 2 * a1 * inverse;
      d_var[i] = by_var;
      d_cov[i] = by_cov;
      d_mean[i] = 2 * (my * a2 - mx * ssim * b2) * inverse - 2 * mx * by_var - my * by_cov;
    }
    return total;
  }

  // The window sums of the SSIM derivatives (the window is symmetric: its adjoint is itself), then
  // d/dx = S(d_mean) + 2 x S(d_var) + y S(d_cov) at masked x, y.
  void ssim_gradient_row(int y) {
    const SsimTaps taps = taps_;
    const float* from[kPartials];
    for (int map = 0; map < kPartials; map++)
      from[map] = columns_.row(y, map) - kSsimRadius * kChannels;
    const float *x = masked_.row(y, 0), *t = masked_.row(y, 1);
    float* to = gradient_ + (size_t)y * n_;
    const float scale = -ssim_scale_;
#pragma omp simd
    for (int i = 0; i < n_; i++) {
      float mean = 0, var = 0, cov = 0;
#pragma GCC unroll 11
      for (int k = 0; k < kSsimWindow; k++) {
        mean += taps.g[k] * from[kDMean][i + kChannels * k];
        var += taps.g[k] * from[kDVariance][i + kChannels * k];
        cov += taps.g[k] * from[kDCovariance][i + kChannels * k];
      }
      to[i] = scale * (mean + 2 * x[i] * var + t[i] * cov);
    }
  }

  void finish_rows(int begin, int end) {
    if (gradient_)
      for (int map = 0; map < kPartials; map++)
        window_sums(partials_, map, begin, 0, n_, columns_.row(begin, map),
                    columns_.row(begin + 1, map));
    for (int y = begin; y < end; y++) finish_row(y);
  }

  // Adds L1 and its gradient to row y, and puts the gradient under the mask.
  void finish_row(int y) {
    if (gradient_) ssim_gradient_row(y);
    spread(in_.weight, y, weight_.data());
    if (in_.mask) spread(in_.mask, y, mask_.data());
    const float *x = masked_.row(y, 0), *t = masked_.row(y, 1);
    const float *weight = weight_.data(), *mask = mask_.data();
    float l1 = 0;
#pragma omp simd reduction(+ : l1)
    for (int i = 0; i < n_; i++) l1 += weight[i] * std::fabs(x[i] - t[i]);
    row_loss_[y] += (double)l1_scale_ * l1;
    if (!gradient_) return;
    float* g = gradient_ + (size_t)y * n_;
    const float scale = l1_scale_;
#pragma omp simd
    for (int i = 0; i < n_; i++) {
      const float d = x[i] - t[i], slope = scale * weight[i];
      g[i] = mask[i] * (g[i] + (d > 0 ? slope : d < 0 ? -slope : 0.0f));
    }
  }

  const PhotometricInput& in_;
  const int n_;
  const float l1_scale_, ssim_scale_;
  double* row_loss_;
  float* gradient_;
  std::vector<float> weight_, mask_;  // one row, spread over channels; ones without a mask
  RowRing<2> masked_;                 // M rendered, M target
  RowRing<1> squares_, product_;      // x^2 + y^2, x y
  RowRing<kStatistics> blurred_;
  RowRing<kPartials> partials_;
  RowRing<kPartials> columns_;  // vertical window sums of the partials
  const SsimTaps taps_;
};

// Returns the loss; writes dL/drendered [H, W, 3] unless `gradient` is null. Rows are summed in
// order, and bands begin at the first of two rows: nothing depends on the number of threads.
static float photometric(const PhotometricInput& in, int threads, float* gradient) {
  std::vector<double> row_loss(in.height, 0.0);
  Pool::run(threads, [&](int part) {
    const int first = part_begin(in.height, kRowsAtOnce, threads, part);
    const int last = part_begin(in.height, kRowsAtOnce, threads, part + 1);
    if (first < last) PhotometricBand(in, row_loss.data(), gradient).run(first, last);
  });
  double loss = 0;
  for (double row : row_loss) loss += row;
  return (float)loss;
}

}  // namespace aq
