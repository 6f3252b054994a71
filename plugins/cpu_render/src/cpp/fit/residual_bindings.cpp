#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "fit/comparison_arrays.hpp"
#include "fit/residual_pass.hpp"
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

  void backward(ConstFloatArray latents, ConstFloatArray units, ConstFloatArray gates,
            std::vector<ConstFloatArray> gradients, double weight, FloatArray latent_gradient,
            FloatArray matrix_gradient, FloatArray gate_gradient) {
    ResidualBackwardJob job{};
    job.forward = job_of(latents, units, gates);
    require(job.forward.rows == table_.rows(), "backward must follow a decode of the same rows");
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
    table_.backward(job, matrix_out);
  }

  ResidualTable& table() { return table_; }

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

using StepArray = nb::ndarray<int32_t, nb::c_contig, nb::device::cpu>;
using NodeArray = nb::ndarray<const int64_t, nb::c_contig, nb::device::cpu>;
// Values [n, d], Adam's two moments of them, the steps that each row has taken [n], and whether they look ahead.
using Trained = std::tuple<FloatArray, FloatArray, FloatArray, StepArray, bool>;
// A rasteriser, what its view is compared with, which rows wait, and a factor on the rates.
using View = std::tuple<nb::object, nb::object, std::optional<ByteArray>, double>;

AdamJob adam_of(const Trained& trained, const std::tuple<double, double, double>& betas_eps) {
  const auto& [values, first, second, steps, ahead] = trained;
  require(values.ndim() == 2 && first.size() == values.size() && second.size() == values.size() &&
              steps.size() == values.shape(0),
          "Adam's moments must have the shape of their table");
  AdamJob job{};
  job.rows = values.shape(0);
  job.columns = values.shape(1);
  job.param = values.data();
  job.exp_avg = first.data();
  job.exp_avg_sq = second.data();
  job.step = steps.data();
  job.ahead = ahead;
  std::tie(job.beta1, job.beta2, job.eps) = betas_eps;
  return job;
}

// The views of a pass over `rows` rows, which their rasterisers are frozen to.
std::vector<PassView> views_of(const std::vector<View>& views, std::size_t rows) {
  std::vector<PassView> out;
  for (const auto& [object, comparison, waiting, lr_factor] : views) {
    Rasterizer& rasterizer = native_rasterizer(object);
    rasterizer.expect("forward_active");
    require(rasterizer.active_count() == rows, "every view must be frozen to the rows of the table");
    require(!waiting || waiting->size() == rows, "waiting must be [A]");
    const auto& arrays = nb::cast<const ComparisonArrays&>(comparison);
    out.push_back({&rasterizer, arrays.view(rasterizer.width(), rasterizer.height()),
                   waiting ? waiting->data() : nullptr, lr_factor});
  }
  return out;
}

std::vector<double> run(PyResidualTable& table, const std::vector<View>& views, const SceneArrays& base,
                        std::vector<std::size_t> attributes, ConstFloatArray units, ConstFloatArray steps,
                        NodeArray node_of, const std::vector<float>& rule, double weight, std::ptrdiff_t position,
                        const Trained& logits, const Trained& latents, const Trained& matrix, double gate_lr,
                        ConstFloatArray lrs, ConstFloatArray decoder_lrs,
                        const std::tuple<double, double, double>& betas_eps) {
  ResidualPass pass{};
  pass.table = &table.table();
  pass.rows = base.scene.count;
  const GaussianArrays& rows = base.scene.arrays;
  const float* const arrays[] = {rows.means, rows.quats, rows.scales, rows.opacities, rows.sh0, rows.shN};
  const auto widths = row_widths(base.scene.sh_degree);
  std::copy_n(arrays, ATTRIBUTES, pass.base);
  pass.sh_degree = base.scene.sh_degree;
  const std::vector<ResidualBlock>& blocks = pass.table->blocks();
  require(attributes.size() == blocks.size(), "one attribute for each block");
  for (std::size_t b = 0; b < blocks.size(); b++)
    require(attributes[b] < ATTRIBUTES && blocks[b].width == widths[attributes[b]], "blocks as wide as attributes");
  pass.attribute = std::move(attributes);
  pass.logits = adam_of(logits, betas_eps);
  pass.latents = adam_of(latents, betas_eps);
  pass.matrix = adam_of(matrix, betas_eps);
  pass.nodes = pass.logits.rows;
  require(pass.logits.columns == 1, "logits must be [M, 1]");
  require(pass.latents.rows == pass.rows && pass.latents.columns == pass.table->latents(), "latents must be [A, L]");
  require(pass.matrix.rows == pass.table->latents() && pass.matrix.columns == pass.table->features(),
          "matrix must be [L, D]");
  require(units.size() == pass.rows && node_of.size() == pass.rows, "units and nodes must be [A]");
  for (std::size_t i = 0; i < pass.rows; i++)
    require(node_of.data()[i] >= 0 && static_cast<std::size_t>(node_of.data()[i]) < pass.nodes, "a node beyond the gates");
  for (const ConstFloatArray* array : {&steps, &lrs, &decoder_lrs})
    require_floats(*array, pass.table->latents(), "steps and rates must be [L]");
  require(rule.size() == 8, "a rule has eight numbers");
  require(position >= -1 && position + 3 <= static_cast<std::ptrdiff_t>(pass.table->latents()), "a column beyond latents");
  pass.units = units.data();
  pass.steps = steps.data();
  pass.node_of = node_of.data();
  pass.rule = {rule[0], rule[1], rule[2], rule[3], rule[4], rule[5], rule[6], rule[7]};
  pass.weight = static_cast<float>(weight);
  pass.position = position;
  pass.logits.lr = gate_lr;
  pass.latents.lr_columns = lrs.data();
  pass.matrix.lr_rows = decoder_lrs.data();
  const std::vector<PassView> ready = views_of(views, pass.rows);
  const nb::gil_scoped_release released;
  return run_pass(pass, ready);
}

}  // namespace

void bind_residual(nb::module_& module) {
  const auto strict = [](const char* name) { return nb::arg(name).noconvert(); };
  nb::class_<PyResidualTable>(module, "ResidualTable", "Residuals of rows; see gsstream_cpu_render.residual.")
      .def(nb::init<const std::vector<Block>&, std::size_t, std::size_t>(), nb::arg("blocks"), nb::arg("latents"),
           nb::arg("features"))
      .def("decode", &PyResidualTable::decode, strict("latents"), strict("matrix"), strict("steps"), strict("units"),
           strict("gates"), strict("base"), strict("out"))
      .def("backward", &PyResidualTable::backward, strict("latents"), strict("units"), strict("gates"), strict("gradients"),
           nb::arg("weight"), strict("latent_gradient"), strict("matrix_gradient"), strict("gate_gradient"))
      .def("run", &run, nb::arg("views"), nb::arg("base"), nb::arg("attributes"), strict("units"), strict("steps"),
           strict("node_of"), nb::arg("rule"), nb::arg("weight"), nb::arg("position"), strict("logits"),
           strict("latents"), strict("matrix"), nb::arg("gate_lr"), strict("lrs"), strict("decoder_lrs"),
           nb::arg("betas_eps"), "Losses of the iterations made: one for each view, or fewer before a fault.");
}

}  // namespace gsstream_cpu
