/* The steps of a delta, displacements: sections 4.2 and 4.3. */
#include "decoder.h"

static const uint8_t order[] = {LIGHT, MOTION, FIELD, GATES, PATTERN, DECODERS, MEANS, QUATS, SCALES, OPACITIES, SH0, SHN,
                                REMOVED, ADDED};

static int check_sections(gss_stream *s, const packet *p)
{
    unsigned at = 0, attributes = 0;
    NEED(s, p->sections > 0, "R-4.2-2");
    for (unsigned i = 0; i < p->sections; i++) {
        while (at < sizeof order && order[at] != p->number[i])
            at++;
        NEED(s, at < sizeof order, "R-4.2-2");
        attributes += p->number[i] >= MEANS;
    }
    NEED(s, gss_section(p, GATES) || (!attributes && !gss_section(p, PATTERN) && !gss_section(p, DECODERS)), "R-4.2-3");
    NEED(s, attributes || !gss_section(p, PATTERN), "R-4.2-4");
    return 1;
}

/* next becomes a copy of last, without displacements. */
static int copy_state(gss_stream *s, const state *last, state *next)
{
    region *keep = &s->states[!s->now];
    uint32_t n = last->scene.rows, m = last->scene.nodes;
    *next = *last;
    next->scene.displaced = NULL;
    next->scene.translations = NULL;
    next->scene.rotations = NULL;
    TRY(gss_allocate_scene(s, keep, &next->scene));
    for (unsigned a = 0; a < ATTRIBUTES; a++)
        gss_copy(gss_column(&next->scene, a), gss_column(&last->scene, a),
                 (uint64_t)n * gss_width(&last->scene, a) * sizeof(float));
    TRY(next->scene.node_counts = gss_take(s, keep, m, sizeof(uint32_t)));
    gss_copy(next->scene.node_counts, last->scene.node_counts, (uint64_t)m * sizeof(uint32_t));
    TRY(next->unit_of_row = gss_take(s, keep, n, 1));
    gss_copy(next->unit_of_row, last->unit_of_row, n);
    for (unsigned a = 0; a < ATTRIBUTES; a++) {
        uint32_t count = last->decoders[a].latents * last->decoders[a].width;
        if (!count)
            continue;
        TRY(next->decoders[a].weights = gss_take(s, keep, count, sizeof(float)));
        gss_copy(next->decoders[a].weights, last->decoders[a].weights, count * sizeof(float));
    }
    if (last->grouped) {
        TRY(next->group_of_row = gss_take(s, keep, n, sizeof(uint32_t)));
        gss_copy(next->group_of_row, last->group_of_row, (uint64_t)n * sizeof(uint32_t));
    }
    return 1;
}

static void rotation_between(const float *before, const float *after, float *out)
{
    double w0 = before[0], x0 = before[1], y0 = before[2], z0 = before[3];
    double w1 = after[0], x1 = after[1], y1 = after[2], z1 = after[3];
    double w = w1 * w0 + x1 * x0 + y1 * y0 + z1 * z0;
    double x = x1 * w0 - w1 * x0 - y1 * z0 + z1 * y0;
    double y = y1 * w0 - w1 * y0 + x1 * z0 - z1 * x0;
    double z = z1 * w0 - w1 * z0 - x1 * y0 + y1 * x0;
    double size = (w0 * w0 + x0 * x0 + y0 * y0 + z0 * z0) * (w1 * w1 + x1 * x1 + y1 * y1 + z1 * z1);
    int turned = w != 0 && 4 * (w * w) >= size;
    out[0] = turned ? (float)(x / w) : 0.0f;
    out[1] = turned ? (float)(y / w) : 0.0f;
    out[2] = turned ? (float)(z / w) : 0.0f;
}

static int displace(gss_stream *s, const state *last, state *next, const uint8_t *touched)
{
    region *keep = &s->states[!s->now];
    uint32_t n = next->scene.rows;
    uint8_t *displaced = gss_zeros(s, keep, n, 1);
    float *translations = NULL, *rotations = NULL;
    TRY(displaced);
    TRY(translations = gss_zeros(s, keep, (uint64_t)n * 3, sizeof(float)));
    TRY(rotations = gss_zeros(s, keep, (uint64_t)n * 3, sizeof(float)));
    int any = 0;
    for (uint32_t i = 0; i < n; i++) {
        if (!touched[i])
            continue;
        const float *before = last->scene.means + (size_t)3 * i, *after = next->scene.means + (size_t)3 * i;
        float *t = translations + (size_t)3 * i, *r = rotations + (size_t)3 * i;
        for (int axis = 0; axis < 3; axis++)
            t[axis] = after[axis] - before[axis];
        rotation_between(last->scene.quats + (size_t)4 * i, next->scene.quats + (size_t)4 * i, r);
        displaced[i] = t[0] != 0 || t[1] != 0 || t[2] != 0 || r[0] != 0 || r[1] != 0 || r[2] != 0;
        any |= displaced[i];
    }
    if (any) {
        next->scene.displaced = displaced;
        next->scene.translations = translations;
        next->scene.rotations = rotations;
    }
    return 1;
}

int gss_delta_packet(gss_stream *s, const packet *p, const state *last, state *next)
{
    TRY(check_sections(s, p));
    TRY(copy_state(s, last, next));
    uint8_t *touched = gss_zeros(s, &s->scratch, last->scene.rows, 1);
    TRY(touched);
    const span *motion = gss_section(p, MOTION), *field = gss_section(p, FIELD);
    const span *light = gss_section(p, LIGHT);
    if (light)
        TRY(gss_apply_light(s, *light, next));
    if (motion)
        TRY(gss_motions(s, *motion, last, next, touched));
    if (field)
        TRY(gss_apply_field(s, *field, next, touched));
    if (gss_section(p, GATES))
        TRY(gss_residual(s, p, next, touched));
    TRY(displace(s, last, next, touched));
    return gss_rows(s, p, next);
}
