/* The field: section 4.5. */
#include "decoder.h"

enum { HEAD = 52, MOST_LEVELS = 16, MOST_INPUTS = 128, OUTPUTS = 7 };

typedef struct {
    unsigned marked, levels, log_entries, features, width, hidden;
    uint32_t base, seed, entry_step, weight_step;
    float growth, reach, lower[3], upper[3];
    uint32_t cells[MOST_LEVELS];
    int32_t *entry[MOST_LEVELS]; /* [2^e, F], in units of 2^-20 */
    int32_t *weight[5];          /* [inputs, outputs] of each layer, in units of 2^-14 */
} grid;

/* Where a row is on one level: its corners' entries and their weights. */
typedef struct {
    uint32_t entry[8];
    double weight[8];
} corners;

static int read_head(gss_stream *s, span from, grid *g)
{
    NEED(s, from.size >= HEAD, "R-1.3-6");
    const uint8_t *h = from.at;
    g->marked = h[0];
    g->levels = h[1];
    g->log_entries = h[2];
    g->features = h[3];
    g->width = h[4];
    g->hidden = h[5];
    g->base = u16_at(h + 6);
    g->seed = u32_at(h + 8);
    g->entry_step = u32_at(h + 12);
    g->weight_step = u32_at(h + 16);
    g->growth = f32_at(h + 20);
    g->reach = f32_at(h + 24);
    NEED(s, g->marked <= 1, "R-4.5-1");
    NEED(s, g->levels >= 1 && g->levels <= MOST_LEVELS && g->log_entries >= 1 && g->log_entries <= 20, "R-4.5-2");
    NEED(s, g->features >= 1 && g->features <= 8 && g->width >= 1 && g->width <= 128, "R-4.5-2");
    NEED(s, g->hidden >= 1 && g->hidden <= 4 && g->base >= 1 && g->base <= 1024, "R-4.5-2");
    NEED(s, g->levels << g->log_entries <= 1u << 20, "R-4.5-2");
    NEED(s, g->entry_step >= 1 && g->entry_step <= 1u << 25, "R-4.5-3");
    NEED(s, g->weight_step >= 1 && g->weight_step <= 1u << 17, "R-4.5-3");
    NEED(s, g->growth >= 1 && g->growth <= 4 && g->reach > 0 && g->reach < 1e9f, "R-4.5-4");
    for (int axis = 0; axis < 3; axis++) {
        g->lower[axis] = f32_at(h + 28 + 4 * axis);
        g->upper[axis] = f32_at(h + 40 + 4 * axis);
        NEED(s, isfinite(g->lower[axis]) && isfinite(g->upper[axis]) && g->lower[axis] < g->upper[axis], "R-4.5-4");
    }
    double times = 1;
    for (unsigned level = 0; level < g->levels; level++, times = times * g->growth) {
        double cells = trunc(g->base * times);
        NEED(s, cells <= 1 << 20, "R-4.5-5");
        g->cells[level] = (uint32_t)cells;
    }
    return 1;
}

static uint32_t mix(uint32_t v)
{
    v ^= v >> 16;
    v *= 0x7FEB352Du;
    v ^= v >> 15;
    v *= 0x846CA68Bu;
    return v ^ v >> 16;
}

static int32_t draw(uint32_t n, int32_t r, uint32_t mixed_seed)
{
    return (int32_t)((uint64_t)(mix(n + mixed_seed) >> 8) * (2 * (uint32_t)r + 1) >> 24) - r;
}

static int within(const grid *g, const float *mean, double u[3])
{
    for (int axis = 0; axis < 3; axis++) {
        u[axis] = ((double)mean[axis] - g->lower[axis]) / ((double)g->upper[axis] - g->lower[axis]);
        if (!(u[axis] >= 0 && u[axis] <= 1))
            return 0;
    }
    return 1;
}

static void find_corners(const grid *g, unsigned level, const double u[3], corners *out)
{
    uint64_t c = g->cells[level], k[3];
    double share[3][2];
    for (int axis = 0; axis < 3; axis++) {
        double p = u[axis] * (double)c, cell = floor(p), last = (double)c - 1;
        cell = cell < last ? cell : last;
        k[axis] = (uint64_t)cell;
        share[axis][1] = p - cell;
        share[axis][0] = 1 - share[axis][1];
    }
    uint32_t mask = (1u << g->log_entries) - 1;
    int dense = (c + 1) * (c + 1) * (c + 1) <= (uint64_t)1 << g->log_entries;
    for (unsigned corner = 0; corner < 8; corner++) {
        unsigned i = corner >> 2, j = corner >> 1 & 1, m = corner & 1;
        uint64_t x = k[0] + i, y = k[1] + j, z = k[2] + m;
        uint64_t entry = dense ? (x * (c + 1) + y) * (c + 1) + z : (x ^ 2654435761u * y ^ 805459861u * z) & mask;
        out->entry[corner] = (uint32_t)entry;
        out->weight[corner] = (share[0][i] * share[1][j]) * share[2][m];
    }
}

/* The rows that the field moves. */
static int find_rows(gss_stream *s, span marks, const grid *g, const gss_frame *scene, uint32_t **rows, uint32_t *count)
{
    gates marked = {0};
    double u[3];
    if (g->marked)
        TRY(gss_gates(s, marks, scene->rows, 1, &marked));
    else
        NEED(s, marks.size == 0, "R-4.5-7");
    TRY(*rows = gss_take(s, &s->scratch, scene->rows, sizeof **rows));
    *count = 0;
    for (uint32_t i = 0; i < scene->rows; i++)
        if ((!g->marked || marked.level[i]) && within(g, scene->means + (size_t)3 * i, u))
            (*rows)[(*count)++] = i;
    return 1;
}

/* What is touched becomes known by the corners of all rows; its symbols follow in ascending order. */
static int read_level(gss_stream *s, span part, grid *g, unsigned level, const gss_frame *scene, const uint32_t *rows,
                      uint32_t count)
{
    uint32_t entries = 1u << g->log_entries, touched = 0, rank = 0, seed = mix(g->seed);
    uint8_t *used = gss_zeros(s, &s->scratch, entries, 1);
    int32_t *symbols;
    TRY(used);
    for (uint32_t i = 0; i < count; i++) {
        double u[3];
        corners at;
        within(g, scene->means + (size_t)3 * rows[i], u);
        find_corners(g, level, u, &at);
        for (unsigned corner = 0; corner < 8; corner++) {
            touched += !used[at.entry[corner]];
            used[at.entry[corner]] = 1;
        }
    }
    TRY(gss_symbols(s, part, touched, g->features, &symbols));
    TRY(g->entry[level] = gss_take(s, &s->scratch, (uint64_t)entries * g->features, sizeof(int32_t)));
    for (uint32_t q = 0; q < entries; q++) {
        if (!used[q])
            continue;
        for (uint32_t f = 0; f < g->features; f++) {
            int64_t change = (int64_t)symbols[(size_t)f * touched + rank] * g->entry_step;
            NEED(s, change < 1 << 25 && change > -(1 << 25), "R-4.5-8");
            uint32_t n = (level * entries + q) * g->features + f;
            g->entry[level][(size_t)q * g->features + f] = draw(n, 105, seed) + (int32_t)change;
        }
        rank++;
    }
    return 1;
}

static uint32_t inputs_of(const grid *g, unsigned layer) { return layer ? g->width : g->levels * g->features; }

static uint32_t outputs_of(const grid *g, unsigned layer) { return layer < g->hidden ? g->width : OUTPUTS; }

static int read_network(gss_stream *s, const span *parts, grid *g)
{
    uint32_t n = 1u << 31, seed = mix(g->seed);
    for (unsigned layer = 0; layer <= g->hidden; layer++) {
        uint32_t inputs = inputs_of(g, layer), outputs = outputs_of(g, layer);
        int32_t *symbols, r = layer < g->hidden ? (int32_t)(16384 * sqrt(6.0 / inputs)) : 0;
        TRY(gss_symbols(s, parts[layer], inputs, outputs, &symbols));
        TRY(g->weight[layer] = gss_take(s, &s->scratch, (uint64_t)inputs * outputs, sizeof(int32_t)));
        for (uint32_t i = 0; i < inputs; i++)
            for (uint32_t o = 0; o < outputs; o++) {
                int64_t change = (int64_t)symbols[(size_t)o * inputs + i] * g->weight_step;
                NEED(s, change < 1 << 17 && change > -(1 << 17), "R-4.5-8");
                g->weight[layer][(size_t)i * outputs + o] = draw(n++, r, seed) + (int32_t)change;
            }
    }
    return 1;
}

/* Sums are below 2^53: whole numbers, exact in any order. */
static void run_network(const grid *g, const double inputs[MOST_INPUTS], double out[OUTPUTS])
{
    double values[MOST_INPUTS], sums[MOST_INPUTS];
    memcpy(values, inputs, sizeof values);
    for (unsigned layer = 0; layer <= g->hidden; layer++) {
        uint32_t count = inputs_of(g, layer), outputs = outputs_of(g, layer);
        const int32_t *weight = g->weight[layer];
        for (uint32_t o = 0; o < outputs; o++)
            sums[o] = 0;
        for (uint32_t i = 0; i < count; i++, weight += outputs)
            for (uint32_t o = 0; o < outputs; o++)
                sums[o] += values[i] * weight[o];
        for (uint32_t o = 0; o < outputs; o++) {
            double value = floor(sums[o] * (1.0 / 16384) + 0.5);
            values[o] = value < 0 ? 0 : value > 67108863 ? 67108863 : value;
        }
    }
    for (unsigned o = 0; o < OUTPUTS; o++)
        out[o] = sums[o] * (1.0 / 17179869184.0);
}

static void move_row(const grid *g, float *mean, float *quat)
{
    double u[3], inputs[MOST_INPUTS] = {0}, v[OUTPUTS], turn[4];
    within(g, mean, u);
    for (unsigned level = 0; level < g->levels; level++) {
        corners at;
        find_corners(g, level, u, &at);
        for (unsigned f = 0; f < g->features; f++) {
            double sum = 0;
            for (unsigned corner = 0; corner < 8; corner++)
                sum += at.weight[corner] * g->entry[level][(size_t)at.entry[corner] * g->features + f];
            inputs[level * g->features + f] = floor(sum + 0.5);
        }
    }
    run_network(g, inputs, v);
    for (int axis = 0; axis < 3; axis++)
        mean[axis] = (float)(mean[axis] + v[axis] * g->reach);
    double whole = 1 + v[3];
    whole = whole > 0.1 ? whole : 0.1;
    const double rotation[3] = {v[4] / whole, v[5] / whole, v[6] / whole};
    gss_unit_quaternion(rotation, turn);
    gss_turn(turn, quat);
}

int gss_apply_field(gss_stream *s, span section, state *next, uint8_t *touched)
{
    grid g = {0};
    span part[1 + MOST_LEVELS + 5];
    uint32_t *rows = NULL, count = 0;
    gss_frame *scene = &next->scene;
    TRY(read_head(s, section, &g));
    TRY(gss_parts(s, rest_of(section, HEAD), 1 + g.levels + g.hidden + 1, part));
    TRY(find_rows(s, part[0], &g, scene, &rows, &count));
    uint64_t weights = 0;
    for (unsigned layer = 0; layer <= g.hidden; layer++)
        weights += inputs_of(&g, layer) * outputs_of(&g, layer);
    NEED(s, count * (8 * g.levels * g.features + weights) <= (uint64_t)1 << 35, "R-4.5-6");
    for (unsigned level = 0; level < g.levels; level++)
        TRY(read_level(s, part[1 + level], &g, level, scene, rows, count));
    TRY(read_network(s, part + 1 + g.levels, &g));
    for (uint32_t i = 0; i < count; i++) {
        touched[rows[i]] = 1;
        move_row(&g, scene->means + (size_t)3 * rows[i], scene->quats + (size_t)4 * rows[i]);
    }
    return 1;
}
