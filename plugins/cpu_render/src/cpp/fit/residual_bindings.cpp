#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "fit/residual_table.hpp"
#include "runtime/bindings.hpp"

namespace nb = nanobind;

namespace gsstream_cpu {
namespace {

// The Python side has checked everything with messages for people; these checks only keep memory safe.
void require(bool good, const char* what) {
  if (!good) throw std::invalid_argument(std::string("residual table: ") + what);
}

void require_floats(const ConstFloatArray& array, std::size_t floats, const char* what) {
  require(array.size() == floats, what);
}

using Block = std::tuple<std::size_t, std::size_t, std::size_t, std::size_t, bool, bool>;

class PyResidualTable {
 public:
  PyResidualTable(const std::vector<Block>& blocks, std::size_t latents, std::size_t features)
      : table_(checked(blocks, latents, features), latents, features) {}

  void decode(ConstFloatArray latents, ConstFloatArray matrix, ConstFloatArray steps, ConstFloatArray units,
              ConstFloatArray gates, std::vector<ConstFloatArray> base, std::vector<FloatArray> out) {
    ResidualJob job = job_of(latents, units, gates);
    require_floats(matrix, table_.latents() * table_.features(), "matrix must be [L, D]");
    require_floats(steps, table_.latents(), "steps must be [L]");
    require(base.size() == table_.blocks().size() && out.size() == base.size(), "one array per attribute");
    std::vector<const float*> from;
    std::vector<float*> to;
    for (std::size_t b = 0; b < base.size(); b++) {
      const std::size_t floats = job.rows * table_.blocks()[b].width;
      require(base[b].size() == floats && out[b].size() == floats, "attributes must be [A, width]");
      from.push_back(base[b].data());
      to.push_back(out[b].data());
    }
    job.base = from.data();
    job.out = to.data();
    const nb::gil_scoped_release released;
    table_.decode(job, matrix.data(), steps.data());
  }

  void pull(ConstFloatArray latents, ConstFloatArray units, ConstFloatArray gates,
            std::vector<ConstFloatArray> gradients, double weight, FloatArray latent_gradient,
            FloatArray matrix_gradient, FloatArray gate_gradient) {
    ResidualPullJob job{};
    job.forward = job_of(latents, units, gates);
    require(job.forward.rows == table_.rows(), "pull must follow a decode of the same rows");
    require(gradients.size() == table_.blocks().size(), "one gradient per attribute");
    std::vector<const float*> from;
    for (std::size_t b = 0; b < gradients.size(); b++) {
      require_floats(gradients[b], job.forward.rows * table_.blocks()[b].width, "gradients must be [A, width]");
      from.push_back(gradients[b].data());
    }
    require(latent_gradient.size() == latents.size() && matrix_gradient.size() == table_.latents() * table_.features() &&
                gate_gradient.size() == gates.size(),
            "outputs must have the shapes of what they belong to");
    job.gradient = from.data();
    job.weight = static_cast<float>(weight);
    job.latent_gradient = latent_gradient.data();
    job.gate_gradient = gate_gradient.data();
    float* matrix_out = matrix_gradient.data();
    const nb::gil_scoped_release released;
    table_.pull(job, matrix_out);
  }

 private:
  static std::vector<ResidualBlock> checked(const std::vector<Block>& blocks, std::size_t latents,
                                            std::size_t features) {
    std::vector<ResidualBlock> out;
    require(features <= MOST_FEATURES, "more features than a Gaussian has");
    for (const auto& [latent, count, feature, width, in_units, trained] : blocks) {
      require(latent + count <= latents && feature + width <= features, "columns of an attribute beyond the table");
      out.push_back({latent, count, feature, width, in_units, trained});
    }
    return out;
  }

  ResidualJob job_of(const ConstFloatArray& latents, const ConstFloatArray& units, const ConstFloatArray& gates) const {
    require(latents.ndim() == 2 && latents.shape(1) == table_.latents(), "latents must be [A, L]");
    const std::size_t rows = latents.shape(0);
    require_floats(units, rows, "units must be [A]");
    require_floats(gates, rows, "gates must be [A]");
    ResidualJob job{};
    job.rows = rows;
    job.latent = latents.data();
    job.units = units.data();
    job.gates = gates.data();
    return job;
  }

  ResidualTable table_;
};

}  // namespace

void bind_residual(nb::module_& module) {
  const auto strict = [](const char* name) { return nb::arg(name).noconvert(); };
  nb::class_<PyResidualTable>(module, "ResidualTable", "Residuals of rows; see gsstream_cpu_render.residual.")
      .def(nb::init<const std::vector<Block>&, std::size_t, std::size_t>(), nb::arg("blocks"), nb::arg("latents"),
           nb::arg("features"))
      .def("decode", &PyResidualTable::decode, strict("latents"), strict("matrix"), strict("steps"), strict("units"),
           strict("gates"), strict("base"), strict("out"))
      .def("pull", &PyResidualTable::pull, strict("latents"), strict("units"), strict("gates"), strict("gradients"),
           nb::arg("weight"), strict("latent_gradient"), strict("matrix_gradient"), strict("gate_gradient"));
}

}  // namespace gsstream_cpu
