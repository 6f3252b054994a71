// The kernels without Python: reads a scene, renders it, differentiates, takes a loss and an Adam step, and writes every
// output. For processors that are emulated, where no interpreter is at hand: `driver INPUT OUTPUT`.
//
// INPUT: int32 N, coefficients - 1, width, height, active rows; float32 near, viewmat [16], K [9], background [3], means,
// quats, scales, opacities, sh0, shN, image gradient [H,W,3], target [H,W,3]; uint32 active ids.
// OUTPUT: name length (int32), name, count (int64), float32 values; until the end of the file.
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <stdexcept>
#include <string>
#include <vector>

#include "adam/adam.hpp"
#include "photometric/photometric.hpp"
#include "raster/rasterizer.hpp"

using namespace gsstream_cpu;

namespace {

class Input {
 public:
  explicit Input(const char* path) : file_(std::fopen(path, "rb")) {
    if (!file_) throw std::runtime_error(std::string("cannot read ") + path);
  }
  ~Input() { std::fclose(file_); }
  template <class T>
  std::vector<T> take(std::size_t count) {
    std::vector<T> values(count);
    if (count && std::fread(values.data(), sizeof(T), count, file_) != count) throw std::runtime_error("input too short");
    return values;
  }

 private:
  std::FILE* file_;
};

class Output {
 public:
  explicit Output(const char* path) : file_(std::fopen(path, "wb")) {
    if (!file_) throw std::runtime_error(std::string("cannot write ") + path);
  }
  ~Output() { std::fclose(file_); }
  void put(const std::string& name, const std::vector<float>& values) {
    const int32_t length = static_cast<int32_t>(name.size());
    const int64_t count = static_cast<int64_t>(values.size());
    std::fwrite(&length, sizeof length, 1, file_);
    std::fwrite(name.data(), 1, name.size(), file_);
    std::fwrite(&count, sizeof count, 1, file_);
    std::fwrite(values.data(), sizeof(float), values.size(), file_);
  }

 private:
  std::FILE* file_;
};

// As scene_arrays.hpp makes it from Python's arrays.
Camera make_camera(const std::vector<float>& v, const std::vector<float>& k, int width, int height, float near) {
  Camera c{};
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) c.rotation[3 * i + j] = v[4 * i + j];
    c.translation[i] = v[4 * i + 3];
  }
  for (int j = 0; j < 3; j++)
    c.position[j] = -(c.rotation[j] * c.translation[0] + c.rotation[3 + j] * c.translation[1] +
                      c.rotation[6 + j] * c.translation[2]);
  c.fx = k[0], c.fy = k[4], c.cx = k[2], c.cy = k[5], c.near = near;
  const float margin_x = 0.15f * static_cast<float>(width) / c.fx, margin_y = 0.15f * static_cast<float>(height) / c.fy;
  c.x_low = -c.cx / c.fx - margin_x, c.x_high = (static_cast<float>(width) - c.cx) / c.fx + margin_x;
  c.y_low = -c.cy / c.fy - margin_y, c.y_high = (static_cast<float>(height) - c.cy) / c.fy + margin_y;
  c.width = width, c.height = height;
  return c;
}

struct Arrays {
  std::vector<float> means, quats, scales, opacities, sh0, shN, means2d;
  Arrays(std::size_t n, std::size_t rest)
      : means(3 * n), quats(4 * n), scales(3 * n), opacities(n), sh0(3 * n), shN(3 * rest * n), means2d(2 * n) {}
  GradientArrays gradients() {
    return {means.data(), quats.data(), scales.data(), opacities.data(), sh0.data(), shN.data(), means2d.data()};
  }
  void write(Output& out, const std::string& name) const {
    out.put(name + "means", means), out.put(name + "quats", quats), out.put(name + "scales", scales);
    out.put(name + "opacities", opacities), out.put(name + "sh0", sh0), out.put(name + "shN", shN);
    out.put(name + "means2d", means2d);
  }
};

std::vector<float> rows(const std::vector<float>& values, std::size_t width, const std::vector<uint32_t>& ids) {
  std::vector<float> out;
  for (uint32_t id : ids) out.insert(out.end(), values.begin() + width * id, values.begin() + width * (id + 1));
  return out;
}

void loss(Output& out, const std::vector<float>& image, const std::vector<float>& target, int width, int height) {
  PhotometricJob job{};
  job.height = height, job.width = width;
  job.tile_rows = (height + kTile - 1) / kTile, job.tile_columns = (width + kTile - 1) / kTile;
  const std::vector<uint8_t> all(static_cast<std::size_t>(job.tile_rows * job.tile_columns), 1);
  std::vector<float> gradient(image.size());
  const float scale = 1.0f / static_cast<float>(image.size());
  job.image = image.data(), job.target = {target.data(), nullptr}, job.active = job.wanted = all.data();
  job.gradient = gradient.data(), job.l1_scale = 0.8f * scale, job.ssim_scale = -0.2f * scale;
  const PhotometricSums sums = photometric_run(job);
  out.put("loss", {static_cast<float>(sums.l1 * scale), static_cast<float>(sums.dssim * scale)});
  out.put("loss gradient", gradient);
}

void adam(Output& out, std::vector<float> param, const std::vector<float>& gradient, std::size_t columns) {
  std::vector<float> first(param.size()), second(param.size());
  AdamJob job{};
  job.rows = param.size() / columns, job.columns = columns;
  job.param = param.data(), job.exp_avg = first.data(), job.exp_avg_sq = second.data(), job.grad = gradient.data();
  job.lr = 0.01, job.beta1 = 0.9, job.beta2 = 0.999, job.eps = 1e-15;
  std::vector<int32_t> steps(job.rows);
  job.step = steps.data();
  for (int update = 1; update <= 3; update++) adam_run(job);
  out.put("adam", param), out.put("adam first", first), out.put("adam second", second);
}

void run(const char* in, const char* result) {
  Input input(in);
  Output out(result);
  const std::vector<int32_t> sizes = input.take<int32_t>(5);
  const std::size_t n = sizes[0], rest = sizes[1], pixels = static_cast<std::size_t>(sizes[2]) * sizes[3];
  const int width = sizes[2], height = sizes[3];
  const float near = input.take<float>(1)[0];
  const std::vector<float> viewmat = input.take<float>(16), k = input.take<float>(9), background = input.take<float>(3);
  const Camera camera = make_camera(viewmat, k, width, height, near);
  const auto means = input.take<float>(3 * n), quats = input.take<float>(4 * n), scales = input.take<float>(3 * n);
  const auto opacities = input.take<float>(n), sh0 = input.take<float>(3 * n), shN = input.take<float>(3 * rest * n);
  const auto upstream = input.take<float>(3 * pixels), goal = input.take<float>(3 * pixels);
  const auto active = input.take<uint32_t>(static_cast<std::size_t>(sizes[4]));

  Scene scene;
  scene.arrays = {means.data(), quats.data(), scales.data(), opacities.data(), sh0.data(), shN.data()};
  scene.count = n, scene.sh_degree = rest == 0 ? 0 : rest == 3 ? 1 : rest == 8 ? 2 : 3;
  std::vector<float> image(3 * pixels), transmittance(pixels);
  const Target target{{background[0], background[1], background[2]}, image.data(), transmittance.data()};
  Rasterizer rasterizer;
  if (rasterizer.forward(scene, camera, nullptr, target)) throw std::runtime_error("the scene has a fault");
  out.put("image", image), out.put("transmittance", transmittance);
  Arrays full(n, rest);
  rasterizer.backward(upstream.data(), nullptr, full.gradients(), false);
  full.write(out, "");
  loss(out, image, goal, width, height);
  adam(out, means, full.means, 3);

  rasterizer.freeze(nullptr, active.data(), active.size());
  const auto m = rows(means, 3, active), q = rows(quats, 4, active), s = rows(scales, 3, active);
  const auto o = rows(opacities, 1, active), c = rows(sh0, 3, active), h = rows(shN, 3 * rest, active);
  Scene some = scene;
  some.arrays = {m.data(), q.data(), s.data(), o.data(), c.data(), h.data()};
  some.count = active.size();
  if (rasterizer.forward_active(some, target, false)) throw std::runtime_error("the active rows have a fault");
  out.put("active image", image);
  Arrays part(active.size(), rest);
  rasterizer.backward_active(upstream.data(), nullptr, part.gradients());
  part.write(out, "active ");
}

}  // namespace

int main(int count, char** arguments) {
  if (count != 3) return std::fputs("usage: driver INPUT OUTPUT\n", stderr), 2;
  try {
    run(arguments[1], arguments[2]);
  } catch (const std::exception& error) {
    return std::fprintf(stderr, "error: %s\n", error.what()), 1;
  }
}
