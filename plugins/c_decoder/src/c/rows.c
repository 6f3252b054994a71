/* Rows that leave and join: section 4.7. */
#include "decoder.h"

/* What the section added brings. */
typedef struct {
    uint32_t nodes;    /* new ones */
    gss_frame scene;
    uint32_t *of_node; /* [M + nodes], rows that each node receives */
    uint8_t *unit;     /* [B] */
} joining;

static int read_joining(gss_stream *s, span section, const state *next, uint32_t stay, joining *out)
{
    span part[11];
    bits head;
    uint64_t b, k, sum = 0;
    uint32_t m = next->scene.nodes;
    int32_t *parents, *counts, *units;
    TRY(gss_parts(s, section, 11, part));
    head.from = part[0];
    head.bit = 0;
    TRY(gss_gamma(s, &head, &b));
    TRY(gss_gamma(s, &head, &k));
    b += 1;
    TRY(gss_end_of_bits(s, &head, "R-4.7-2"));
    NEED(s, b <= (uint64_t)64 * section.size && k <= (uint64_t)64 * section.size, "R-4.7-3");
    NEED(s, stay + b <= MOST_ROWS && m + k <= MOST_ROWS, "R-4.7-3");
    out->nodes = (uint32_t)k;
    out->scene.rows = (uint32_t)b;
    TRY(gss_symbols(s, part[1], out->nodes, 1, &parents));
    for (uint32_t i = 0; i < out->nodes; i++)
        NEED(s, parents[i] >= 0 && (uint32_t)parents[i] <= m + i, "R-4.7-4");
    gates receive;
    TRY(gss_gates(s, part[2], m + out->nodes, 1, &receive));
    TRY(gss_symbols(s, part[3], receive.open, 1, &counts));
    TRY(out->of_node = gss_take(s, &s->scratch, m + out->nodes, sizeof(uint32_t)));
    for (uint32_t node = 0; node < m + out->nodes; node++) {
        out->of_node[node] = 0;
        if (!receive.level[node])
            continue;
        NEED(s, *counts > 0, "R-4.7-5");
        sum += out->of_node[node] = (uint32_t)*counts++;
    }
    NEED(s, sum == b, "R-4.7-5");
    TRY(gss_symbols(s, part[4], out->scene.rows, 1, &units));
    TRY(out->unit = gss_take(s, &s->scratch, out->scene.rows, 1));
    for (uint32_t i = 0; i < out->scene.rows; i++) {
        NEED(s, units[i] >= 0 && (uint32_t)units[i] < next->units, "R-4.7-6");
        out->unit[i] = (uint8_t)units[i];
    }
    NEED(s, part[10].size < 2 || part[10].at[1] == 3 * next->scene.harmonics, "R-4.7-7");
    return gss_gaussians(s, part + 5, &s->scratch, &out->scene);
}

/* The new order: source[i] is a row of before, or OLD + the number of a row that joins. */
enum { OLD = 1 << 30 };

static int order_rows(gss_stream *s, const state *before, const uint8_t *leaves, const joining *join, state *after,
                      uint32_t **source)
{
    region *keep = &s->states[!s->now];
    uint32_t m = before->scene.nodes, nodes = m + join->nodes, at = 0, row = 0, joined = 0;
    TRY(*source = gss_take(s, &s->scratch, after->scene.rows, sizeof **source));
    TRY(after->scene.node_counts = gss_take(s, keep, nodes, sizeof(uint32_t)));
    for (uint32_t node = 0; node < nodes; node++) {
        uint32_t begin = at, old = node < m ? before->scene.node_counts[node] : 0;
        for (uint32_t i = 0; i < old; i++, row++)
            if (!leaves || !leaves[row])
                (*source)[at++] = row;
        for (uint32_t i = 0; join->of_node && i < join->of_node[node]; i++)
            (*source)[at++] = OLD + joined++;
        after->scene.node_counts[node] = at - begin;
    }
    after->scene.nodes = nodes;
    return 1;
}

/* Copy what each row has: bytes of row number i from old or joined; zeros where a row that joins has nothing. */
static void gather(uint8_t *to, const void *old, const void *joined, const uint32_t *source, uint32_t rows, size_t bytes)
{
    for (uint32_t i = 0; i < rows; i++, to += bytes) {
        int joins = source[i] >= OLD;
        size_t row = joins ? source[i] - OLD : source[i];
        if (!joins)
            gss_copy(to, (const uint8_t *)old + row * bytes, bytes);
        else if (joined)
            gss_copy(to, (const uint8_t *)joined + row * bytes, bytes);
        else
            memset(to, 0, bytes);
    }
}

static int gather_displacements(gss_stream *s, const gss_frame *before, gss_frame *after, const uint32_t *source)
{
    region *keep = &s->states[!s->now];
    uint32_t n = after->rows;
    uint8_t *displaced = gss_take(s, keep, n, 1);
    float *translations = NULL, *rotations = NULL;
    TRY(displaced);
    TRY(translations = gss_take(s, keep, (uint64_t)n * 3, sizeof(float)));
    TRY(rotations = gss_take(s, keep, (uint64_t)n * 3, sizeof(float)));
    gather(displaced, before->displaced, NULL, source, n, 1);
    gather((uint8_t *)translations, before->translations, NULL, source, n, 3 * sizeof(float));
    gather((uint8_t *)rotations, before->rotations, NULL, source, n, 3 * sizeof(float));
    after->displaced = displaced;
    after->translations = translations;
    after->rotations = rotations;
    return 1;
}

static int gather_groups(gss_stream *s, const state *before, state *after, const uint32_t *source)
{
    uint32_t n = after->scene.rows, i = 0;
    while (i < n && source[i] >= OLD)
        i++;
    if (i == n) { /* no row stayed */
        after->grouped = 0;
        after->group_of_row = NULL;
        return 1;
    }
    TRY(after->group_of_row = gss_take(s, &s->states[!s->now], n, sizeof(uint32_t)));
    uint32_t group = before->group_of_row[source[i]];
    for (i = 0; i < n; i++) {
        if (source[i] < OLD)
            group = before->group_of_row[source[i]];
        after->group_of_row[i] = group;
    }
    return 1;
}

int gss_rows(gss_stream *s, const packet *p, state *next)
{
    const span *removed = gss_section(p, REMOVED), *added = gss_section(p, ADDED);
    if (!removed && !added)
        return 1;
    const state before = *next;
    region *keep = &s->states[!s->now];
    gates leaves = {0};
    joining join = {0};
    uint32_t *source;
    if (removed) {
        TRY(gss_gates(s, *removed, before.scene.rows, 1, &leaves));
        NEED(s, leaves.open > 0, "R-4.7-1");
    }
    uint32_t stay = before.scene.rows - leaves.open;
    if (added)
        TRY(read_joining(s, *added, &before, stay, &join));
    next->scene.rows = stay + join.scene.rows;
    TRY(order_rows(s, &before, removed ? leaves.level : NULL, &join, next, &source));
    TRY(gss_allocate_scene(s, keep, &next->scene));
    for (unsigned a = 0; a < ATTRIBUTES; a++)
        gather((uint8_t *)gss_column(&next->scene, a), gss_column(&before.scene, a),
               added ? gss_column(&join.scene, a) : NULL, source, next->scene.rows,
               gss_width(&before.scene, a) * sizeof(float));
    TRY(next->unit_of_row = gss_take(s, keep, next->scene.rows, 1));
    gather(next->unit_of_row, before.unit_of_row, join.unit, source, next->scene.rows, 1);
    if (before.scene.displaced)
        TRY(gather_displacements(s, &before.scene, &next->scene, source));
    return before.grouped ? gather_groups(s, &before, next, source) : 1;
}
