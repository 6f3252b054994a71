#include "fit/residual_pass.hpp"

#include <algorithm>
#include <cmath>

#include "runtime/buffer.hpp"

namespace gsstream_cpu {
namespace {

float sigmoid(float x) { return 1.0f / (1.0f + std::exp(-x)); }

// What an iteration leaves to the next one: memory.
struct Scratch {
  Buffer<float> out[ATTRIBUTES], gradient[ATTRIBUTES];
  Buffer<float> means2d, latent_gradient, matrix_gradient, row_gates, by_row;
  std::vector<float> gates, grads, by_node, costs, latent_rates, matrix_rates;
};

class Run {
 public:
  explicit Run(const ResidualPass& pass) : pass_(pass), latents_(pass.latents), matrix_(pass.matrix) {
    arrays_ = point_at_rows();
    s_.row_gates.require(pass.rows);
    s_.by_row.require(pass.rows);
    latents_.grad = s_.latent_gradient.require(pass.rows * pass.latents.columns);
    matrix_.grad = s_.matrix_gradient.require(pass.matrix.rows * pass.matrix.columns);
    for (std::vector<float>* values : {&s_.gates, &s_.grads, &s_.by_node, &s_.costs}) values->resize(pass.nodes);
  }

  // False where there is a fault: then nothing has changed.
  bool step(const PassView& view, double& loss) {
    open_gates(view.waiting);
    decode();
    const Scene scene{arrays_, pass_.rows, pass_.sh_degree};
    const ViewLossGrad found = view_loss_and_grad(*view.rasterizer, scene, view.comparison, gradients_);
    if (found.faults) return false;
    const double l1 = view.comparison.l1_scale, dssim = -view.comparison.ssim_scale;
    loss = l1 * found.sums.l1 + dssim * found.sums.dssim;
    if (!std::isfinite(loss)) return false;
    residual_backward();
    gate_penalty(view.waiting);
    return move(view.lr_factor);
  }

 private:
  // Where rows are rendered from: those of the table that it decodes, and the others as they are.
  GaussianArrays point_at_rows() {
    const auto widths = row_widths(pass_.sh_degree);
    const float* rows[ATTRIBUTES];
    float* gradients[ATTRIBUTES];
    for (std::size_t a = 0; a < ATTRIBUTES; a++) {
      rows[a] = pass_.base[a];
      gradients[a] = s_.gradient[a].require(pass_.rows * widths[a]);
    }
    for (std::size_t a : pass_.attribute) {
      float* decoded = s_.out[a].require(pass_.rows * widths[a]);
      rows[a] = decoded;
      bases_.push_back(pass_.base[a]);
      decoded_.push_back(decoded);
      upstream_.push_back(gradients[a]);
    }
    gradients_ = {gradients[0], gradients[1], gradients[2], gradients[3], gradients[4], gradients[5],
                  s_.means2d.require(2 * pass_.rows)};
    return {rows[0], rows[1], rows[2], rows[3], rows[4], rows[5]};
  }

  void open_gates(const uint8_t* waiting) {
    const GateRule& rule = pass_.rule;
    for (std::size_t m = 0; m < pass_.nodes; m++) {
      const float x = pass_.logits.param[m] / rule.temperature + rule.shift, soft = sigmoid(x);
      s_.gates[m] = std::nearbyint(soft * rule.levels) / rule.levels;
      s_.grads[m] = soft * sigmoid(-x) / rule.temperature;
    }
    for (std::size_t i = 0; i < pass_.rows; i++)
      s_.row_gates[i] = waiting && waiting[i] ? 0.0f : s_.gates[static_cast<std::size_t>(pass_.node_of[i])];
  }

  ResidualJob job() const {
    ResidualJob job{};
    job.rows = pass_.rows;
    job.latent = pass_.latents.param;
    job.units = pass_.units;
    job.gates = s_.row_gates.data();
    return job;
  }

  void decode() {
    ResidualJob forward = job();
    forward.base = bases_.data();
    forward.out = decoded_.data();
    pass_.table->decode(forward, pass_.matrix.param, pass_.steps);
  }

  void residual_backward() {
    ResidualBackwardJob backward{};
    backward.forward = job();
    backward.gradient = upstream_.data();
    backward.weight = pass_.weight;
    backward.latent_gradient = s_.latent_gradient.data();
    backward.gate_gradient = s_.by_row.data();
    pass_.table->backward(backward, s_.matrix_gradient.data());
  }

  // The gradient of the logits, in s_.by_node; what positions behind open gates cost is added to that of the latents.
  void gate_penalty(const uint8_t* waiting) {
    const GateRule& rule = pass_.rule;
    const std::size_t columns = pass_.latents.columns;
    std::vector<float>&upstream = s_.by_node, &open = s_.gates;  // gates are not needed any more
    std::fill(upstream.begin(), upstream.end(), 0.0f);
    std::fill(s_.costs.begin(), s_.costs.end(), 0.0f);
    for (std::size_t m = 0; m < pass_.nodes; m++) open[m] = sigmoid(pass_.logits.param[m] - rule.margin);
    for (std::size_t i = 0; i < pass_.rows; i++) {
      if (waiting && waiting[i]) continue;
      const std::size_t m = static_cast<std::size_t>(pass_.node_of[i]);
      upstream[m] += s_.by_row[i];
      float squared = 0.0f;
      if (pass_.position >= 0) {
        const float* residual = pass_.latents.param + i * columns + pass_.position;
        float* gradient = s_.latent_gradient.data() + i * columns + pass_.position;
        for (int axis = 0; axis < 3; axis++) {
          squared += residual[axis] * residual[axis];
          if (rule.motion != 0.0f) gradient[axis] += 2.0f * rule.motion / rule.divisor * open[m] * residual[axis];
        }
      }
      s_.costs[m] += rule.open_weight + rule.motion * squared;
    }
    for (std::size_t m = 0; m < pass_.nodes; m++) {
      const float grad = open[m] * sigmoid(rule.margin - pass_.logits.param[m]);
      upstream[m] = upstream[m] * s_.grads[m] + grad * (s_.costs[m] / rule.divisor);
    }
  }

  bool move(double lr_factor) {
    AdamJob logits = pass_.logits, latents = latents_, matrix = matrix_;
    logits.grad = s_.by_node.data();
    for (const AdamJob* job : {&logits, &latents, &matrix})
      if (job->rows && job->columns && adam_first_bad(*job) >= 0) return false;
    latents.lr_columns = scaled(pass_.latents.lr_columns, pass_.latents.columns, lr_factor, s_.latent_rates);
    matrix.lr_rows = scaled(pass_.matrix.lr_rows, pass_.matrix.rows, lr_factor, s_.matrix_rates);
    for (const AdamJob* job : {&logits, &latents, &matrix})
      if (job->rows && job->columns) adam_run(*job);
    const float bound = pass_.rule.bound;
    for (std::size_t m = 0; m < pass_.nodes; m++) logits.param[m] = std::fmin(std::fmax(logits.param[m], -bound), bound);
    return true;
  }

  static const float* scaled(const float* rates, std::size_t count, double factor, std::vector<float>& out) {
    out.resize(count);
    for (std::size_t i = 0; i < count; i++) out[i] = static_cast<float>(factor) * rates[i];
    return out.data();
  }

  const ResidualPass& pass_;
  Scratch s_;
  AdamJob latents_, matrix_;
  GaussianArrays arrays_;
  GradientArrays gradients_{};
  std::vector<const float*> bases_, upstream_;
  std::vector<float*> decoded_;
};

}  // namespace

std::vector<double> run_pass(const ResidualPass& pass, const std::vector<PassView>& views) {
  Run run(pass);
  std::vector<double> losses;
  for (const PassView& view : views) {
    double loss = 0.0;
    const bool made = run.step(view, loss);
    view.rasterizer->forget();  // the arrays of its pass end with this call
    if (!made) break;
    losses.push_back(loss);
  }
  return losses;
}

}  // namespace gsstream_cpu
