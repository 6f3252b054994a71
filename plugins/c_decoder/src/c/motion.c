/* Motions of groups: section 4.4. */
#include "decoder.h"

typedef struct {
    uint64_t key;
    uint32_t row;
} keyed;

static uint32_t limited(double value, double least, double most)
{
    double whole = floor(value);
    return (uint32_t)((whole > least ? whole < most ? whole : most : least) - least);
}

/* Sort by key, rows of equal keys in their order: 13 bits at a time of 52. */
static keyed *sorted(keyed *from, keyed *to, uint32_t n, uint32_t *count)
{
    for (unsigned shift = 0; shift < 52; shift += 13) {
        memset(count, 0, ((size_t)8192 + 1) * sizeof *count);
        for (uint32_t i = 0; i < n; i++)
            count[(from[i].key >> shift & 8191) + 1]++;
        for (uint32_t k = 0; k < 8192; k++)
            count[k + 1] += count[k];
        for (uint32_t i = 0; i < n; i++)
            to[count[from[i].key >> shift & 8191]++] = from[i];
        keyed *other = from;
        from = to;
        to = other;
    }
    return from;
}

static int form_groups(gss_stream *s, state *next, float cell, uint32_t bins)
{
    uint32_t n = next->scene.rows, group = 0;
    keyed *one = gss_take(s, &s->scratch, n, sizeof *one), *two = NULL;
    uint32_t *count = NULL;
    TRY(one);
    TRY(two = gss_take(s, &s->scratch, n, sizeof *two));
    TRY(count = gss_take(s, &s->scratch, 8192 + 1, sizeof *count));
    TRY(next->group_of_row = gss_take(s, &s->states[!s->now], n, sizeof(uint32_t)));
    for (uint32_t i = 0; i < n; i++) {
        const float *mean = next->scene.means + (size_t)3 * i, *rgb = next->scene.sh0 + (size_t)3 * i;
        uint64_t key = 0;
        for (int axis = 0; axis < 3; axis++)
            key = key << 16 | limited((double)mean[axis] / (double)cell, -32768, 32767);
        double bright = 0.5 + 0.28209479177387814 * (0.25 * rgb[0] + 0.5 * rgb[1] + 0.25 * rgb[2]);
        one[i].key = key << 4 | limited(bright * bins, 0, bins - 1.0);
        one[i].row = i;
    }
    const keyed *found = sorted(one, two, n, count);
    for (uint32_t i = 0; i < n; i++) {
        group += i && found[i].key != found[i - 1].key;
        next->group_of_row[found[i].row] = group;
    }
    next->grouped = 1;
    next->cell = cell;
    next->brightness_bins = bins;
    next->groups = n ? group + 1 : 0;
    return 1;
}

/* What a moving group does. */
typedef struct {
    double centre[3], start[6], rows, displaced;
    double rotation[9], quat[4];
} mover;

static void sum_rows(const state *last, const state *next, const uint32_t *mover_of, mover *movers, int predicted)
{
    const gss_frame *before = &last->scene;
    for (uint32_t i = 0; i < next->scene.rows; i++) {
        uint32_t which = mover_of[next->group_of_row[i]];
        if (!which)
            continue;
        mover *m = &movers[which - 1];
        m->rows += 1;
        for (int axis = 0; axis < 3; axis++)
            m->centre[axis] += next->scene.means[(size_t)3 * i + axis];
        if (!predicted || !before->displaced || !before->displaced[i])
            continue;
        m->displaced += 1;
        for (int axis = 0; axis < 3; axis++) {
            m->start[axis] += before->translations[(size_t)3 * i + axis];
            m->start[3 + axis] += before->rotations[(size_t)3 * i + axis];
        }
    }
}

void gss_unit_quaternion(const double rotation[3], double quat[4])
{
    double x = rotation[0], y = rotation[1], z = rotation[2];
    double scale = 1 / sqrt(1 + x * x + y * y + z * z);
    quat[0] = scale;
    quat[1] = x * scale;
    quat[2] = y * scale;
    quat[3] = z * scale;
}

void gss_turn(const double by[4], float quat[4])
{
    double w0 = by[0], x0 = by[1], y0 = by[2], z0 = by[3];
    double w1 = quat[0], x1 = quat[1], y1 = quat[2], z1 = quat[3];
    quat[0] = (float)(w0 * w1 - x0 * x1 - y0 * y1 - z0 * z1);
    quat[1] = (float)(w0 * x1 + x0 * w1 + y0 * z1 - z0 * y1);
    quat[2] = (float)(w0 * y1 - x0 * z1 + y0 * w1 + z0 * x1);
    quat[3] = (float)(w0 * z1 + x0 * y1 - y0 * x1 + z0 * w1);
}

/* start becomes the transform: the prediction and what the symbols add to it. */
static int finish(gss_stream *s, mover *m, const int32_t *symbols, uint32_t moving, const double step[2])
{
    for (int i = 0; i < 6; i++) {
        double symbol = symbols[(size_t)i * moving];
        NEED(s, fabs(symbol) * step[i / 3] <= 1e18, "R-4.4-5");
        m->start[i] = (m->displaced > 0 ? m->start[i] / m->displaced : 0.0) + symbol * step[i / 3];
    }
    for (int axis = 0; axis < 3; axis++)
        m->centre[axis] = m->rows > 0 ? m->centre[axis] / m->rows : 0.0;
    gss_unit_quaternion(m->start + 3, m->quat);
    double w = m->quat[0], x = m->quat[1], y = m->quat[2], z = m->quat[3];
    const double rotation[9] = {
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    };
    memcpy(m->rotation, rotation, sizeof rotation);
    return 1;
}

static int move_row(gss_stream *s, const mover *m, float *mean, float *quat)
{
    double d[3];
    for (int axis = 0; axis < 3; axis++)
        d[axis] = mean[axis] - m->centre[axis];
    for (int axis = 0; axis < 3; axis++) {
        const double *r = m->rotation + 3 * axis;
        mean[axis] = (float)((((r[0] * d[0] + r[1] * d[1]) + r[2] * d[2]) + m->centre[axis]) + m->start[axis]);
        NEED(s, isfinite(mean[axis]), "R-4.4-7");
    }
    gss_turn(m->quat, quat);
    return 1;
}

static int one_motion(gss_stream *s, span from, const state *last, state *next, uint8_t *touched)
{
    NEED(s, from.size >= 14, "R-1.3-6");
    unsigned flags = from.at[0], bins = from.at[1];
    float cell = f32_at(from.at + 2);
    const double step[2] = {f32_at(from.at + 6), f32_at(from.at + 10)};
    NEED(s, flags <= 3, "R-4.4-2");
    NEED(s, bins >= 1 && bins <= 16, "R-4.4-3");
    NEED(s, cell > 0 && cell < 1e9f && step[0] > 0 && step[0] < 1e9 && step[1] > 0 && step[1] < 1e9, "R-4.4-4");
    if (flags & 2 || !next->grouped || next->cell != cell || next->brightness_bins != bins)
        TRY(form_groups(s, next, cell, bins));
    span part[2];
    gates open;
    int32_t *symbols;
    TRY(gss_parts(s, rest_of(from, 14), 2, part));
    TRY(gss_gates(s, part[0], next->groups, 1, &open));
    TRY(gss_symbols(s, part[1], open.open, 6, &symbols));
    mover *movers = gss_zeros(s, &s->scratch, open.open, sizeof *movers);
    uint32_t *mover_of = NULL, moving = 0; /* 0: the group stays */
    TRY(movers);
    TRY(mover_of = gss_take(s, &s->scratch, next->groups, sizeof *mover_of));
    for (uint32_t g = 0; g < next->groups; g++)
        mover_of[g] = open.level[g] ? ++moving : 0;
    sum_rows(last, next, mover_of, movers, flags & 1);
    for (uint32_t i = 0; i < moving; i++)
        TRY(finish(s, &movers[i], symbols + i, moving, step));
    for (uint32_t i = 0; i < next->scene.rows; i++) {
        uint32_t which = mover_of[next->group_of_row[i]];
        if (!which)
            continue;
        touched[i] = 1;
        TRY(move_row(s, &movers[which - 1], next->scene.means + (size_t)3 * i, next->scene.quats + (size_t)4 * i));
    }
    return 1;
}

int gss_motions(gss_stream *s, span section, const state *last, state *next, uint8_t *touched)
{
    NEED(s, section.size >= 1, "R-1.3-6");
    unsigned count = section.at[0];
    span part[8];
    NEED(s, count >= 1 && count <= 8, "R-4.4-1");
    TRY(gss_parts(s, rest_of(section, 1), count, part));
    for (unsigned i = 0; i < count; i++)
        TRY(one_motion(s, part[i], last, next, touched));
    return 1;
}
