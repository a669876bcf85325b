// Runs every kernel on scenes from files, outside Python: under a sanitizer, under an emulator of
// another processor, or short of memory. kernel_driver.py writes the scenes and reads the results.
//
//   kernel_driver SCENE RESULT [SCENE RESULT ...]
//   kernel_driver --out-of-memory SCENE RESULT   every allocation fails once before it succeeds
#include "aquaflow_native.cpp"

#include <cmath>
#include <cstddef>
#include <cstdio>
#include <cstdlib>
#include <string>

static std::atomic<long> allocations_left{-1};  // negative: no limit

static void* allocate(size_t size, size_t alignment) {
  if (allocations_left.load() >= 0 && allocations_left.fetch_sub(1) <= 0) {
    allocations_left = 0;
    throw std::bad_alloc();
  }
  void* memory = nullptr;
  if (posix_memalign(&memory, alignment, size) != 0) throw std::bad_alloc();
  return memory;
}

void* operator new(size_t size) { return allocate(size, alignof(std::max_align_t)); }
void* operator new(size_t size, const std::nothrow_t&) noexcept {
  try {
    return operator new(size);
  } catch (const std::bad_alloc&) {
    return nullptr;
  }
}
void* operator new(size_t size, std::align_val_t alignment) {
  return allocate(size, (size_t)alignment);
}
void operator delete(void* memory) noexcept { std::free(memory); }
void operator delete(void* memory, size_t) noexcept { std::free(memory); }
void operator delete(void* memory, std::align_val_t) noexcept { std::free(memory); }
void operator delete(void* memory, size_t, std::align_val_t) noexcept { std::free(memory); }

typedef std::vector<float> Floats;

// Exactly as long as its content, so that an address sanitizer sees the first element too far.
class Scene {
 public:
  explicit Scene(const char* path) : file_(std::fopen(path, "rb")) {
    if (!file_) std::perror(path), std::exit(2);
    int32_t header[6];
    read(header, sizeof header);
    count = header[0], channels = header[1], width = header[2], height = header[3],
    threads = header[4];
    const size_t n = count, pixels = (size_t)width * height;
    for (size_t size :
         {3 * n, 4 * n, 3 * n, n, channels * n, (size_t)16, (size_t)4, pixels * channels, pixels,
          3 * pixels, pixels, pixels, (size_t)aq::kWater}) {
      arrays.emplace_back(size);
      read(arrays.back().data(), size * sizeof(float));
    }
    active.resize(header[5]);
    read(active.data(), active.size());
    std::fclose(file_);
  }

  enum {
    kMeans,
    kQuats,
    kScales,
    kOpacities,
    kColours,
    kViewmat,
    kIntrinsics,
    kGImage,
    kGAlpha,
    kTarget,
    kWeight,
    kMask,
    kWaterRates
  };
  const float* operator[](int array) const { return arrays[array].data(); }

  int count, channels, width, height, threads;
  std::vector<Floats> arrays;
  std::vector<uint8_t> active;  // [tiles], or empty

 private:
  void read(void* to, size_t bytes) {
    if (bytes && std::fread(to, 1, bytes, file_) != bytes)
      std::fputs("scene too short\n", stderr), std::exit(2);
  }
  std::FILE* file_;
};

// Calls a kernel until it reports success; unless memory is short that is the first time.
template <class Kernel>
static void run(bool out_of_memory, const Kernel& kernel) {
  for (long allowed = 0;; allowed++) {
    allocations_left = out_of_memory ? allowed : -1;
    const int status = kernel();
    allocations_left = -1;
    if (status == 0) return;
    if (!out_of_memory) std::fprintf(stderr, "kernel returned %d\n", status), std::exit(3);
  }
}

static void draw(const Scene& s, bool short_of_memory, std::FILE* result) {
  const size_t n = s.count, pixels = (size_t)s.width * s.height, c = s.channels;
  const auto write = [&](const Floats& values) {
    if (!values.empty()) std::fwrite(values.data(), sizeof(float), values.size(), result);
  };
  Floats image(pixels * c), alpha(pixels), radius(n);
  std::vector<uint8_t> visible(n);
  Floats g_means(3 * n), g_quats(4 * n), g_scales(3 * n), g_opacities(n), g_colours(c * n),
      g_viewmat(16);
  void* context = aq_context_new();
  run(short_of_memory, [&] {
    return aq_forward(context, s.count, s.channels, s.width, s.height, s.threads, s[s.kMeans],
                      s[s.kQuats], s[s.kScales], s[s.kOpacities], s[s.kColours], s[s.kViewmat],
                      s[s.kIntrinsics], image.data(), alpha.data(), visible.data(), radius.data(),
                      s.active.empty() ? nullptr : s.active.data());
  });
  run(short_of_memory, [&] {
    return aq_backward(context, s[s.kMeans], s[s.kQuats], s[s.kScales], s[s.kOpacities],
                       s[s.kColours], image.data(), s[s.kGImage], s[s.kGAlpha], g_means.data(),
                       g_quats.data(), g_scales.data(), g_opacities.data(), g_colours.data(),
                       g_viewmat.data());
  });
  aq_context_free(context);

  Floats rendered(image), range(pixels), g_drawn(4 * pixels), g_a(pixels), g_water(aq::kWater);
  if (s.channels == 4) {
    rendered.resize(3 * pixels);
    run(short_of_memory, [&] {
      return aq_compose_water(image.data(), alpha.data(), s[s.kWaterRates], s[s.kWeight],
                              s[s.kGAlpha], (int)pixels, s.threads, rendered.data(), range.data());
    });
    run(short_of_memory, [&] {
      return aq_compose_water_backward(image.data(), alpha.data(), s[s.kWaterRates], s[s.kWeight],
                                       s[s.kGAlpha], (int)pixels, s.threads, s[s.kTarget],
                                       s[s.kGAlpha], g_drawn.data(), g_a.data(), g_water.data());
    });
  }
  Floats loss(1), g_rendered(3 * pixels);
  run(short_of_memory, [&] {
    return aq_photometric(rendered.data(), s[s.kTarget], s[s.kWeight], s[s.kMask], s.width,
                          s.height, 0.2f, s.threads, loss.data(), g_rendered.data());
  });

  Floats range_loss(1), g_range(pixels);
  run(short_of_memory, [&] {
    return aq_range_loss(range.data(), alpha.data(), s[s.kWeight], s[s.kMask], 1e-2f, (int)pixels,
                         s.threads, range_loss.data(), g_range.data());
  });
  std::vector<uint8_t> within(pixels);
  run(short_of_memory, [&] {
    return aq_outlier_mask(rendered.data(), s[s.kTarget], s[s.kWeight], 0.2f, (int)pixels,
                           s.threads, within.data());
  });

  Floats means(s.arrays[s.kMeans]), first(3 * n), second(3 * n);
  std::vector<int32_t> steps(n);
  const Floats bias{10.0f, 31.622776f};
  const AdamGroup group{means.data(), g_means.data(), first.data(), second.data(), 3, 1e-3f};
  run(short_of_memory, [&] {
    const int more_threads = s.threads + 1;  // the pool has to grow
    const int skipped = aq_adam_step(1, &group, s.count, visible.data(), steps.data(), 0.9, 0.999,
                                     1e-8f, bias.data(), 1, more_threads);
    return skipped < 0 ? skipped : 0;
  });
  for (const Floats* values : {&image, &alpha}) write(*values);
  write(Floats(visible.begin(), visible.end()));
  for (const Floats* values :
       {&radius, &g_means, &g_quats, &g_scales, &g_opacities, &g_colours, &g_viewmat, &rendered,
        &range, &g_drawn, &g_a, &g_water, &loss, &g_rendered, &means})
    write(*values);
}

// The kernels of dense matching, on pictures and flows of the scene's size; numbers of every kind.
static void match(const Scene& s, bool short_of_memory) {
  const size_t pixels = (size_t)s.width * s.height;
  const Floats wild{0.3f, -2.5f, 1e30f, NAN, 7.0f, INFINITY, -INFINITY, -0.0f, 1e-40f};
  std::vector<uint8_t> a(pixels), b(pixels), valid(pixels);
  Floats flow(2 * pixels), refined(2 * pixels), confidence(pixels);
  std::vector<double> rho(pixels), variance(pixels);
  for (size_t i = 0; i < pixels; i++) {
    a[i] = (uint8_t)(255.0f * s[s.kTarget][3 * i]);
    b[i] = (uint8_t)(255.0f * s[s.kTarget][3 * i + 1]);
    valid[i] = i % 5 != 0;
    confidence[i] = wild[i % wild.size()];
    rho[i] = wild[(i / 2) % wild.size()];
    variance[i] = wild[(i / 3) % wild.size()];
  }
  for (size_t i = 0; i < flow.size(); i++) flow[i] = wild[i % wild.size()];
  const Floats contrast(8, 1.0f / 15.0f), window(7, 1.0f / 13.0f);
  run(short_of_memory, [&] {
    return aq_refine_flow(a.data(), b.data(), flow.data(), s.width, s.height, contrast.data(), 7,
                          window.data(), 6, 2.0f, 1.0f, 1e-3f, refined.data());
  });
  std::vector<float> error(pixels);
  if (aq_check_flow(flow.data(), refined.data(), confidence.data(), confidence.data(), s.width,
                    s.height, 2.0f, 1.0f, 30.0f, error.data(), valid.data()) != 0)
    std::exit(4);
  const FuseDepths in{flow.data(),
                      valid.data(),
                      confidence.data(),
                      rho.data(),
                      variance.data(),
                      s.width,
                      s.height,
                      50.0,
                      50.0,
                      26.0,
                      20.0,
                      50.0,
                      50.0,
                      26.0,
                      20.0,
                      {1, 0, 0, 0, 1, 0, 0, 0, 1},
                      {0.1, 0.0, 0.02},
                      0.5,
                      1e-9,
                      1e6,
                      1e-3,
                      1.5,
                      1e-12,
                      2.6e-3,
                      1e6,
                      0.005,
                      0.01,
                      0.003,
                      3.0,
                      1.3,
                      0.5};
  const int measured = aq_fuse_depths(&in);
  if (measured < 0 || (size_t)measured > pixels) std::exit(4);

  // Places in front of, behind and beside the camera, and wild ones.
  const int64_t place_count = (int64_t)(pixels / 3);
  std::vector<double> total(pixels), weights(pixels), around(rho);
  std::vector<int32_t> near(pixels);
  for (size_t i = 2; i < pixels; i += 3) around[i] = 0.01 * (double)(i % 700) - 1.0;
  const ViewSurface surface{flow.data(),
                            confidence.data(),
                            confidence.data(),
                            s.width,
                            s.height,
                            50.0,
                            50.0,
                            26.0,
                            20.0,
                            {1, 0, 0, 0, 1, 0, 0, 0, 1},
                            {0.1, 0.0, 0.02},
                            3.0,
                            0.09,
                            0.18};
  const FuseRanges ranges{surface,     around.data(), total.data(), weights.data(),
                          near.data(), place_count,   0.03,         10.0};
  aq_fuse_ranges(&ranges);
  const SeePlaces places{surface, around.data(), place_count};
  const std::vector<uint16_t> halves(3 * pixels, 0x3555);
  std::vector<double> sums(9 * pixels), least(pixels, 1e9);
  const PlaceColours colours{halves.data(), sums.data(), weights.data(), least.data()};
  if (aq_add_colours(&places, &colours) != 0) std::exit(4);
  const PlaceInformation information{1.0, sums.data(), least.data()};
  if (aq_add_information(&places, &information) != 0) std::exit(4);

  // Wild depths and matches; more of them than a block holds.
  const int count = (int)pixels;
  const double* wild_values = rho.data();
  std::vector<double> left(2 * pixels), pull(6 * pixels);
  PoseEquations pose{wild_values,
                     variance.data(),
                     wild_values,
                     variance.data(),
                     wild_values,
                     variance.data(),
                     wild_values,
                     wild_values,
                     count,
                     50.0,
                     50.0,
                     26.0,
                     20.0,
                     0.5,
                     {1, 0, 0, 0, 1, 0, 0, 0, 1},
                     {0.1, 0.0, 0.02},
                     1.0,
                     1e-3,
                     1.345,
                     10.0,
                     0.5,
                     3.0};
  const PoseLeft out{left.data(), pull.data()};
  PoseResult result;
  if (aq_pose_equations(&pose, &result, &out) != 0) std::exit(4);
  pose.nearer = nullptr;
  if (aq_pose_equations(&pose, &result, nullptr) != 0) std::exit(4);
}

// An anchor's points in two views that are turned by atan(3 / 4), larger and smaller; outliers,
// points that no view sees, and depths that are not known; test_neon.py makes the same numbers.
static void adjust(const Scene& s, bool short_of_memory, std::FILE* result) {
  const int views = 2, points = s.width, n = 7 * (1 + views);
  std::vector<double> R, t, rays, rho, at, known, variance;
  const std::vector<double> sigma{0.5, 0.25};
  std::vector<uint8_t> used;
  for (int v = 0; v < views; v++) {
    for (double value : {0.8, -0.6, 0.0, 0.6, 0.8, 0.0, 0.0, 0.0, 1.0})
      R.push_back((1.0 + 0.1 * v) * value);
    for (int i = 0; i < 3; i++) t.push_back(0.1 * (1 + v + i));
  }
  for (int v = 0; v < views; v++) {
    for (int p = 0; p < points; p++) {
      used.push_back(s[s.kMask][p] > 0.5f && (v == 0 || p % 3 != 0));
      for (int i = 0; i < 2; i++) at.push_back((double)s[s.kTarget][3 * p + i] - 0.4);
    }
  }
  for (int p = 0; p < points; p++) {
    for (int i = 0; i < 2; i++) rays.push_back((double)s[s.kTarget][3 * p + i] - 0.5);
    rays.push_back(1.0);
    rho.push_back(0.5 + (double)s[s.kWeight][p]);
    known.push_back(1.1 * rho.back());
    variance.push_back(p % 7 == 0 ? INFINITY : 0.04);
  }
  const AnchorProblem given{
      R.data(),     t.data(),        rays.data(), rho.data(), at.data(), sigma.data(), used.data(),
      known.data(), variance.data(), views,       points,     1e-3,      2.0,          1e-9};
  std::vector<double> lengths(views * points), H(n * n), gradient(n), gain(points * n),
      offset(points), scores(points * n);
  const AnchorSums sums{H.data(), gradient.data(), gain.data(), offset.data(), scores.data()};
  if (aq_anchor_errors(&given, lengths.data()) != 0) std::exit(4);
  run(short_of_memory, [&] { return aq_anchor_equations(&given, &sums); });
  for (const auto* values : {&lengths, &H, &gradient, &gain, &offset, &scores})
    for (double value : *values) {
      const float single = (float)value;
      std::fwrite(&single, sizeof single, 1, result);
    }
}

int main(int count, char** arguments) {
  const bool short_of_memory = count > 1 && std::string(arguments[1]) == "--out-of-memory";
  for (int i = short_of_memory ? 2 : 1; i + 1 < count; i += 2) {
    std::FILE* result = std::fopen(arguments[i + 1], "wb");
    if (!result) return std::perror(arguments[i + 1]), 2;
    const Scene scene(arguments[i]);
    draw(scene, short_of_memory, result);
    match(scene, short_of_memory);
    adjust(scene, short_of_memory, result);
    std::fclose(result);
  }
}
