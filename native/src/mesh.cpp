// Nearest triangle at every pixel centre; the fast twin of _rasterize_reference in src/toonifygb/render/mesh.py.
//
// Vertices come in whole sub-pixels, so coverage is decided in integers. The image is cut into tiles; each tile meets
// its triangles in their order and keeps the first of equally near ones, so the thread count changes nothing.
#include <algorithm>
#include <cstdint>
#include <limits>
#include <vector>

#include "export.h"
#include "pool.h"

namespace {

constexpr int64_t kSubpixel = 4096;  // SUBPIXEL in mesh.py
constexpr int64_t kHalf = kSubpixel / 2;
constexpr int kTile = 64;  // its depth and winner buffers stay in the first-level cache

struct Mesh {
  const int32_t* xy;
  const double* inverse_depth;
  const int64_t* faces;
};

// First and last pixel whose centre can be inside; empty when first > last.
struct Box {
  int32_t column0, row0, column1, row1;
};

int64_t floor_div(int64_t a, int64_t b) { return a >= 0 ? a / b : -((b - 1 - a) / b); }

int32_t first_pixel(int64_t low) { return int32_t(std::max<int64_t>(floor_div(low + kHalf - 1, kSubpixel), 0)); }

int32_t last_pixel(int64_t high, int size) {
  return int32_t(std::min<int64_t>(floor_div(high - kHalf, kSubpixel), size - 1));
}

// Edge functions of one triangle, oriented so that they are positive inside: edges[k] is opposite corner k.
struct Triangle {
  int64_t x[3], y[3], dx[3], dy[3];
  int64_t owned[3];  // 1 where a centre exactly on the edge belongs to this triangle: left and top edges
  double gain[3];  // 1 / (depth of the corner · twice the area): edges × gain add up to 1 / depth

  Triangle(const Mesh& mesh, int64_t face) {
    const int64_t* corner = mesh.faces + 3 * face;
    for (int k = 0; k < 3; ++k) {
      x[k] = mesh.xy[2 * corner[k]];
      y[k] = mesh.xy[2 * corner[k] + 1];
    }
    const int64_t area = (x[1] - x[0]) * (y[2] - y[0]) - (y[1] - y[0]) * (x[2] - x[0]);
    const int64_t sign = area < 0 ? -1 : 1;
    for (int k = 0; k < 3; ++k) gain[k] = mesh.inverse_depth[corner[k]] / double(sign * area);
    for (int k = 0; k < 3; ++k) {
      const int start = (k + 1) % 3, end = (k + 2) % 3;
      dx[k] = sign * (x[end] - x[start]);
      dy[k] = sign * (y[end] - y[start]);
      owned[k] = dy[k] < 0 || (dy[k] == 0 && dx[k] > 0);
    }
  }

  void edges_at(int column, int row, int64_t edges[3]) const {
    const int64_t px = (2 * int64_t(column) + 1) * kHalf, py = (2 * int64_t(row) + 1) * kHalf;
    for (int k = 0; k < 3; ++k) {
      const int start = (k + 1) % 3;
      edges[k] = dx[k] * (py - y[start]) - dy[k] * (px - x[start]);
    }
  }

  // 1 / depth, which is linear on the screen.
  double nearness(const int64_t edges[3]) const {
    return double(edges[0]) * gain[0] + double(edges[1]) * gain[1] + double(edges[2]) * gain[2];
  }
};

struct Image {
  int width, height;
  int64_t* face_id;
  float* bary;
  float* depth;
};

struct Tile {
  int column0, row0, column1, row1;  // inclusive
  double nearest[kTile * kTile];
  int64_t winner[kTile * kTile];

  int slot(int column, int row) const { return (row - row0) * kTile + (column - column0); }

  void draw(const Mesh& mesh, int64_t face, const Box& box) {
    const Triangle triangle(mesh, face);
    const int c0 = std::max(box.column0, column0), c1 = std::min(box.column1, column1);
    const int r0 = std::max(box.row0, row0), r1 = std::min(box.row1, row1);
    for (int row = r0; row <= r1; ++row) {
      int64_t edges[3];
      triangle.edges_at(c0, row, edges);
      for (int column = c0; column <= c1; ++column) {
        if (((edges[0] + triangle.owned[0] - 1) | (edges[1] + triangle.owned[1] - 1) |
             (edges[2] + triangle.owned[2] - 1)) >= 0) {
          const double near = triangle.nearness(edges);
          const int at = slot(column, row);
          if (near > nearest[at]) {
            nearest[at] = near;
            winner[at] = face;
          }
        }
        for (int k = 0; k < 3; ++k) edges[k] -= triangle.dy[k] * kSubpixel;
      }
    }
  }

  void describe(const Mesh& mesh, const Image& image) const {
    for (int row = row0; row <= row1; ++row) {
      int column = column0;
      while (column <= column1) {
        const int64_t face = winner[slot(column, row)];
        int end = column + 1;
        while (end <= column1 && winner[slot(end, row)] == face) ++end;
        if (face < 0) {
          describe_nothing(column, end, row, image);
        } else {
          describe_run(Triangle(mesh, face), face, column, end, row, image);
        }
        column = end;
      }
    }
  }

  static void describe_nothing(int column, int end, int row, const Image& image) {
    const int64_t pixel = int64_t(row) * image.width + column;
    std::fill_n(image.face_id + pixel, end - column, int64_t(-1));
    std::fill_n(image.depth + pixel, end - column, std::numeric_limits<float>::infinity());
    std::fill_n(image.bary + 3 * pixel, 3 * (end - column), 0.0f);
  }

  void describe_run(const Triangle& triangle, int64_t face, int column, int end, int row, const Image& image) const {
    for (; column < end; ++column) {
      const int64_t pixel = int64_t(row) * image.width + column;
      const double depth = 1.0 / nearest[slot(column, row)];
      int64_t edges[3];
      triangle.edges_at(column, row, edges);
      image.face_id[pixel] = face;
      image.depth[pixel] = float(depth);
      for (int k = 0; k < 3; ++k) image.bary[3 * pixel + k] = float(double(edges[k]) * triangle.gain[k] * depth);
    }
  }
};

// Triangles of each tile, in their order: bin t holds faces[begin[t]] .. faces[begin[t + 1] - 1].
struct Bins {
  int columns, rows;
  std::vector<Box> boxes;
  std::vector<int64_t> begin;
  std::vector<int32_t> faces;

  template <class Visit>
  void for_each_tile(const Box& box, const Visit& visit) const {
    if (box.column0 > box.column1 || box.row0 > box.row1) return;
    for (int r = box.row0 / kTile; r <= box.row1 / kTile; ++r)
      for (int c = box.column0 / kTile; c <= box.column1 / kTile; ++c) visit(r * columns + c);
  }

  Bins(const Mesh& mesh, int64_t n_faces, int width, int height, int threads)
      : columns((width + kTile - 1) / kTile), rows((height + kTile - 1) / kTile), boxes(n_faces) {
    constexpr int64_t kBlock = 4096;
    const int blocks = int((n_faces + kBlock - 1) / kBlock);
    tgb::parallel_for(threads, blocks, [&](int block) {
      const int64_t last = std::min(n_faces, (block + 1) * kBlock);
      for (int64_t face = block * kBlock; face < last; ++face) boxes[face] = box_of(mesh, face, width, height);
    });
    begin.assign(size_t(columns) * rows + 1, 0);
    for (const Box& box : boxes) for_each_tile(box, [&](int tile) { ++begin[tile + 1]; });
    for (size_t tile = 1; tile < begin.size(); ++tile) begin[tile] += begin[tile - 1];
    faces.resize(begin.back());
    std::vector<int64_t> next(begin.begin(), begin.end() - 1);
    for (int64_t face = 0; face < n_faces; ++face)
      for_each_tile(boxes[face], [&](int tile) { faces[next[tile]++] = int32_t(face); });
  }

  static Box box_of(const Mesh& mesh, int64_t face, int width, int height) {
    const int64_t* corner = mesh.faces + 3 * face;
    int64_t x[3], y[3];
    for (int k = 0; k < 3; ++k) {
      x[k] = mesh.xy[2 * corner[k]];
      y[k] = mesh.xy[2 * corner[k] + 1];
    }
    if ((x[1] - x[0]) * (y[2] - y[0]) == (y[1] - y[0]) * (x[2] - x[0])) return {0, 0, -1, -1};
    const auto [x0, x1] = std::minmax({x[0], x[1], x[2]});
    const auto [y0, y1] = std::minmax({y[0], y[1], y[2]});
    return {first_pixel(x0), first_pixel(y0), last_pixel(x1, width), last_pixel(y1, height)};
  }
};

}  // namespace

// Fills face_id (-1 none), bary (3 per pixel, perspective-correct) and depth (infinite where none), row by row.
//
// xy: two per vertex, sub-pixels, |value| < 2^29; inverse_depth: 1 / m, positive; faces: three per triangle, fewer
// than 2^31 triangles.
TGB_API void tgb_mesh_rasterize(const int32_t* xy, const double* inverse_depth, const int64_t* faces, int64_t n_faces,
                                int width, int height, int threads, int64_t* face_id, float* bary, float* depth) {
  const Mesh mesh{xy, inverse_depth, faces};
  const Image image{width, height, face_id, bary, depth};
  const Bins bins(mesh, n_faces, width, height, threads);
  tgb::parallel_for(threads, bins.columns * bins.rows, [&](int index) {
    Tile tile;
    tile.column0 = index % bins.columns * kTile;
    tile.row0 = index / bins.columns * kTile;
    tile.column1 = std::min(tile.column0 + kTile, width) - 1;
    tile.row1 = std::min(tile.row0 + kTile, height) - 1;
    std::fill_n(tile.nearest, kTile * kTile, 0.0);
    std::fill_n(tile.winner, kTile * kTile, int64_t(-1));
    for (int64_t at = bins.begin[index]; at < bins.begin[index + 1]; ++at)
      tile.draw(mesh, bins.faces[at], bins.boxes[bins.faces[at]]);
    tile.describe(mesh, image);
  });
}

// Means of interpolated vertex attributes over blocks of factor × factor samples; samples without a face count as 0.
//
// face_id, bary: (height factor) × (width factor) samples as filled above; attributes: `channels` per vertex;
// means: `channels` per pixel.
TGB_API void tgb_mesh_means(const int64_t* face_id, const float* bary, const int64_t* faces, const float* attributes,
                            int channels, int width, int height, int factor, int threads, float* means) {
  const float share = 1.0f / float(factor * factor);
  tgb::parallel_for(threads, height, [&](int row) {
    for (int column = 0; column < width; ++column) {
      float* mean = means + (int64_t(row) * width + column) * channels;
      std::fill_n(mean, channels, 0.0f);
      for (int y = row * factor; y < (row + 1) * factor; ++y) {
        for (int x = column * factor; x < (column + 1) * factor; ++x) {
          const int64_t sample = int64_t(y) * width * factor + x;
          if (face_id[sample] < 0) continue;
          for (int k = 0; k < 3; ++k) {
            const float* corner = attributes + faces[3 * face_id[sample] + k] * channels;
            const float weight = bary[3 * sample + k] * share;
            for (int c = 0; c < channels; ++c) mean[c] += weight * corner[c];
          }
        }
      }
    }
  });
}
