/* The key packet: sections 3.1, 3.5 and 3.8. */
#include "decoder.h"

static int read_layout(gss_stream *s, span from, uint32_t length, state *next)
{
    NEED(s, from.size >= 9, "R-1.3-6");
    uint32_t n = u32_at(from.at), m = u32_at(from.at + 4), h = from.at[8];
    uint64_t most = 65536 + (uint64_t)64 * length;
    most = most < MOST_ROWS ? most : MOST_ROWS;
    NEED(s, n <= most && m <= most, "R-3.5-1");
    NEED(s, h <= MOST_UNITS, "R-3.5-2");
    NEED(s, from.size - 9 >= 4 * h, "R-1.3-6");
    for (uint32_t i = 0; i < h; i++) {
        next->unit[i] = f32_at(from.at + 9 + 4 * i);
        NEED(s, next->unit[i] > 0 && next->unit[i] < 1e9f, "R-3.5-3");
    }
    next->scene.rows = n;
    next->scene.nodes = m;
    next->units = h;
    span part[2];
    int32_t *counts, *units;
    region *keep = &s->states[!s->now];
    TRY(gss_parts(s, rest_of(from, 9 + 4 * h), 2, part));
    TRY(gss_symbols(s, part[0], m, 1, &counts));
    TRY(gss_symbols(s, part[1], n, 1, &units));
    TRY(next->scene.node_counts = gss_take(s, keep, m, sizeof(uint32_t)));
    TRY(next->unit_of_row = gss_take(s, keep, n, 1));
    uint64_t sum = 0;
    for (uint32_t i = 0; i < m; i++) {
        NEED(s, counts[i] >= 0, "R-3.5-4");
        next->scene.node_counts[i] = (uint32_t)counts[i];
        sum += (uint32_t)counts[i];
    }
    NEED(s, sum == n, "R-3.5-4");
    for (uint32_t i = 0; i < n; i++) {
        NEED(s, units[i] >= 0 && (uint32_t)units[i] < h, "R-3.5-5");
        next->unit_of_row[i] = (uint8_t)units[i];
    }
    return 1;
}

static void interleave(const gss_frame *first, const gss_frame *rest, const int32_t *marks, const gss_frame *whole)
{
    for (unsigned a = 0; a < ATTRIBUTES; a++) {
        uint32_t width = gss_width(whole, a);
        const float *from[2] = {gss_column(rest, a), gss_column(first, a)};
        float *out = gss_column(whole, a);
        for (uint32_t i = 0; i < whole->rows; i++, out += width) {
            gss_copy(out, from[marks[i]], width * sizeof(float));
            from[marks[i]] += width;
        }
    }
}

/* sections: the six attributes of the first layer. */
static int read_layers(gss_stream *s, const packet *p, const span sections[ATTRIBUTES], gss_frame *whole)
{
    span head = p->payload[0], part[1 + ATTRIBUTES];
    NEED(s, head.size == 12, "R-3.8-1");
    gss_frame first = {0}, rest = {0};
    first.rows = u32_at(head.at);
    NEED(s, first.rows <= whole->rows, "R-3.8-2");
    rest.rows = whole->rows - first.rows;
    const uint8_t *begin = head.at + 12, *end = p->payload[7].at + p->payload[7].size;
    uint32_t length = (uint32_t)(end - begin);
    NEED(s, u32_at(head.at + 4) == length, "R-3.8-3");
    NEED(s, u32_at(head.at + 8) == gss_crc(0, begin, length), "R-3.8-4");
    int32_t *marks;
    uint32_t marked = 0;
    TRY(gss_parts(s, p->payload[9], 1 + ATTRIBUTES, part));
    TRY(gss_symbols(s, part[0], whole->rows, 1, &marks));
    for (uint32_t i = 0; i < whole->rows; i++) {
        NEED(s, marks[i] == 0 || marks[i] == 1, "R-3.8-5");
        marked += (uint32_t)marks[i];
    }
    NEED(s, marked == first.rows, "R-3.8-5");
    TRY(gss_gaussians(s, sections, &s->scratch, &first));
    NEED(s, part[6].size < 2 || part[6].at[1] == 3 * first.harmonics, "R-3.8-6");
    TRY(gss_gaussians(s, part + 1, &s->scratch, &rest));
    whole->harmonics = first.harmonics;
    TRY(gss_allocate_scene(s, &s->states[!s->now], whole));
    interleave(&first, &rest, marks, whole);
    return 1;
}

int gss_key_packet(gss_stream *s, const packet *p, state *next, gss_meta_info *meta)
{
    static const uint8_t in_layers[10] = {LAYERS, META, MEANS, QUATS, SCALES, OPACITIES, SH0, SHN, LAYOUT, REST};
    int layers = p->sections == 10 && !memcmp(p->number, in_layers, 10);
    NEED(s, layers || p->sections == 8, "R-3.1-1");
    span attribute[ATTRIBUTES];
    const span *about = gss_section(p, META), *layout = gss_section(p, LAYOUT);
    for (unsigned i = 0; i < ATTRIBUTES; i++) {
        const span *found = gss_section(p, MEANS + i);
        NEED(s, found, "R-3.1-1");
        attribute[i] = *found;
    }
    NEED(s, about && layout, "R-3.1-1");
    TRY(gss_read_meta(s, *about, &s->metas[!s->meta_now], meta));
    TRY(read_layout(s, *layout, p->length, next));
    if (layers)
        return read_layers(s, p, attribute, &next->scene);
    return gss_gaussians(s, attribute, &s->states[!s->now], &next->scene);
}
