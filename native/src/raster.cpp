// C interface of the rasteriser.
#include "raster.h"

#include <ctime>
#include <mutex>
#include <new>
#include <vector>

#include "dispatch.h"
#include "export.h"

namespace {

std::mutex frames_mutex;
std::vector<tgb::Frame*> free_frames;  // kept for ever: their memory is the workspace of the next image

tgb::Frame* take_frame() {
  std::lock_guard<std::mutex> lock(frames_mutex);
  if (free_frames.empty()) return new tgb::Frame;
  tgb::Frame* frame = free_frames.back();
  free_frames.pop_back();
  return frame;
}

void give_frame(tgb::Frame* frame) {
  std::lock_guard<std::mutex> lock(frames_mutex);
  free_frames.push_back(frame);
}

// Processor time of the whole process: on a shared machine the only time that repeats.
class Stopwatch {
 public:
  explicit Stopwatch(double* seconds) : seconds_(seconds), start_(std::clock()) {}
  void lap() {
    if (seconds_ == nullptr) return;
    const std::clock_t now = std::clock();
    *seconds_++ = static_cast<double>(now - start_) / CLOCKS_PER_SEC;
    start_ = now;
  }

 private:
  double* seconds_;
  std::clock_t start_;
};

// The four stages, the first by `project(frame)`. Null when out of memory.
template <class Project>
tgb::Frame* make_frame(const tgb::Scene& scene, float* color, float* alpha, bool keep, double* seconds,
                       const Project& project) {
  tgb::Frame* frame = nullptr;
  try {
    frame = take_frame();
    Stopwatch watch(seconds);
    project(*frame);
    watch.lap();
    tgb::sort_by_depth(*frame, scene);
    watch.lap();
    tgb::bin_into_tiles(*frame, scene, keep);
    watch.lap();
    tgb::kernels().composite_forward(*frame, scene, color, alpha, keep);
    watch.lap();
    return frame;
  } catch (const std::bad_alloc&) {
    delete frame;
    return nullptr;
  }
}

}  // namespace

// Renders `scene` to color [h, w, 3] and alpha [h, w]. `radii` [n] (px, 0 where not visible) and `seconds` [4] (processor
// time of project, sort, bin, composite) may be null. Returns what tgb_raster_backward needs, or null when out of memory;
// hand it back with tgb_raster_release.
TGB_API tgb::Frame* tgb_raster_forward(const tgb::Scene* scene, float* color, float* alpha, int32_t* radii,
                                       double* seconds) {
  return make_frame(*scene, color, alpha, true, seconds,
                    [&](tgb::Frame& frame) { tgb::kernels().project_forward(frame, *scene, radii); });
}

// Renders one frame of an avatar: `psi` [rows], `transforms` [kJoints, 4, 4]; the scene's splats but for sh_degree are
// not looked at. The rest as above. Returns 0 when out of memory.
TGB_API int tgb_play(const tgb::Playback* avatar, const float* psi, const float* transforms, const tgb::Scene* scene,
                     float* color, float* alpha, double* seconds) {
  tgb::Scene view = *scene;
  view.splats.n = avatar->n;
  tgb::Frame* frame = make_frame(view, color, alpha, false, seconds, [&](tgb::Frame& made) {
    tgb::kernels().project_playback(made, view, *avatar, psi, transforms);
  });
  if (frame != nullptr) give_frame(frame);
  return frame != nullptr;
}

// Gradients of the image that tgb_raster_forward made from the same scene. `seconds` [2] (composite, project) may be
// null. May be called again for the same frame. Returns 0 when out of memory.
TGB_API int tgb_raster_backward(tgb::Frame* frame, const tgb::Scene* scene, const tgb::Gradients* gradients,
                                double* seconds) {
  try {
    const tgb::Kernels& kernels = tgb::kernels();
    Stopwatch watch(seconds);
    kernels.composite_backward(*frame, *scene, *gradients);
    watch.lap();
    kernels.project_backward(*frame, *scene, *gradients);
    watch.lap();
    return 1;
  } catch (const std::bad_alloc&) {
    return 0;
  }
}

TGB_API void tgb_raster_release(tgb::Frame* frame) { give_frame(frame); }

// Sizes of a frame: visible Gaussians, (Gaussian, tile) pairs, tiles, and 4 x 4 px blocks composited over all pairs.
TGB_API void tgb_raster_counts(const tgb::Frame* frame, int32_t* counts) {
  const int tiles = frame->tiles_x * frame->tiles_y;
  int32_t blocks = 0;
  for (int tile = 0; tile < tiles; tile++)
    for (uint32_t i = 0; i < frame->tile_used[tile]; i++)
      blocks += __builtin_popcountll(frame->masks[frame->tile_begin[tile] + i]);
  counts[0] = frame->visible, counts[1] = static_cast<int32_t>(frame->pairs), counts[2] = tiles, counts[3] = blocks;
}
