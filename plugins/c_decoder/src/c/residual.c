/* Gates, decoders, pattern and attributes of a delta: section 4.6. */
#include "decoder.h"

/* The rows behind open gates, in stored order. */
typedef struct {
    uint32_t count;
    uint32_t *row;
    float *gate;
    int32_t *pattern; /* NULL: every attribute has symbols for every row */
} opened;

static int open_rows(gss_stream *s, span section, const gss_frame *scene, opened *out)
{
    gates g;
    TRY(gss_gates(s, section, scene->nodes, 0, &g));
    out->count = 0;
    for (uint32_t node = 0; node < scene->nodes; node++)
        out->count += g.level[node] ? scene->node_counts[node] : 0;
    TRY(out->row = gss_take(s, &s->scratch, out->count, sizeof *out->row));
    TRY(out->gate = gss_take(s, &s->scratch, out->count, sizeof *out->gate));
    for (uint32_t node = 0, row = 0, k = 0; node < scene->nodes; node++) {
        uint32_t end = row + scene->node_counts[node];
        float gate = (float)g.level[node] / (float)g.levels;
        if (!g.level[node])
            row = end;
        for (; row < end; row++, k++) {
            out->row[k] = row;
            out->gate[k] = gate;
        }
    }
    return 1;
}

static int read_pattern(gss_stream *s, const packet *p, opened *rows)
{
    const span *section = gss_section(p, PATTERN);
    unsigned attributes = 0;
    rows->pattern = NULL;
    if (!section)
        return 1;
    for (unsigned i = 0; i < p->sections; i++)
        attributes += p->number[i] >= MEANS;
    TRY(gss_symbols(s, *section, rows->count, 1, &rows->pattern));
    for (uint32_t k = 0; k < rows->count; k++)
        NEED(s, rows->pattern[k] >= 0 && rows->pattern[k] < 1 << attributes, "R-4.6-4");
    return 1;
}

static int fits(unsigned attribute, uint32_t width)
{
    gss_frame none = {0};
    return attribute < 5 ? width == gss_width(&none, attribute) : width == 9 || width == 24 || width == 45;
}

static int read_decoders(gss_stream *s, const packet *p, matrix *decoders, int sent[ATTRIBUTES])
{
    const span *section = gss_section(p, DECODERS);
    span from = section ? *section : (span){p->body, 0};
    while (from.size) {
        NEED(s, from.size >= 3, "R-4.6-1");
        uint32_t attribute = from.at[0], latents = from.at[1], width = from.at[2], count = latents * width;
        NEED(s, attribute < ATTRIBUTES && !sent[attribute], "R-4.6-1");
        NEED(s, latents >= 1 && latents <= 64 && fits(attribute, width), "R-4.6-1");
        NEED(s, from.size - 3 >= 2 * count, "R-4.6-1");
        float *weights = gss_take(s, &s->states[!s->now], count, sizeof *weights);
        TRY(weights);
        for (uint32_t i = 0; i < count; i++) {
            const uint8_t *at = from.at + 3 + 2 * i;
            NEED(s, (u16_at(at) >> 10 & 31) != 31, "R-4.6-2");
            weights[i] = gss_half(at);
        }
        decoders[attribute].latents = latents;
        decoders[attribute].width = width;
        decoders[attribute].weights = weights;
        sent[attribute] = 1;
        from = rest_of(from, 3 + 2 * count);
    }
    return 1;
}

/* change = latents times decoder, each product and each sum rounded. */
static void decoded(const matrix *decoder, const float *latent, float *change)
{
    const float *w = decoder->weights;
    for (uint32_t d = 0; d < decoder->width; d++)
        change[d] = latent[0] * w[d];
    for (uint32_t c = 1; c < decoder->latents; c++) {
        w += decoder->width;
        for (uint32_t d = 0; d < decoder->width; d++) {
            float product = latent[c] * w[d];
            change[d] = change[d] + product;
        }
    }
}

static void add(float *value, const float *change, float factor, uint32_t width)
{
    for (uint32_t d = 0; d < width; d++) {
        float part = change[d] * factor;
        value[d] = value[d] + part;
    }
}

/* symbols: [channels, count] of the rows whose bit is set. */
static void apply_symbols(const state *next, const opened *rows, unsigned attribute, int32_t bit,
                          const matrix *decoder, uint32_t channels, const int32_t *symbols, uint32_t count, float step)
{
    float latent[64], change[64], nothing[64] = {0};
    uint32_t width = decoder ? decoder->width : channels, at = 0;
    float *column = gss_column(&next->scene, attribute);
    if (decoder) {
        memset(latent, 0, sizeof latent);
        decoded(decoder, latent, nothing);
    }
    for (uint32_t k = 0; k < rows->count; k++) {
        uint32_t row = rows->row[k];
        float factor = rows->gate[k], *value = column + (size_t)row * width;
        if (attribute == 0)
            factor = factor * next->unit[next->unit_of_row[row]];
        if (rows->pattern && !(rows->pattern[k] & bit)) {
            add(value, nothing, factor, width);
            continue;
        }
        for (uint32_t c = 0; c < channels; c++)
            latent[c] = (float)symbols[(size_t)c * count + at] * step;
        at++;
        if (decoder)
            decoded(decoder, latent, change);
        add(value, decoder ? change : latent, factor, width);
    }
}

static int apply_attribute(gss_stream *s, span from, state *next, const opened *rows, unsigned attribute, int32_t bit,
                           int decoder_sent)
{
    NEED(s, from.size >= 6, "R-1.3-6");
    unsigned mode = from.at[0];
    uint32_t channels = from.at[1], count = rows->count;
    float step = f32_at(from.at + 2);
    const matrix *decoder = mode ? &next->decoders[attribute] : NULL;
    NEED(s, mode <= 1 && (!decoder || decoder->latents), "R-4.6-5");
    NEED(s, mode || !decoder_sent, "R-4.6-3");
    NEED(s, decoder ? channels == decoder->latents : fits(attribute, channels), "R-4.6-6");
    NEED(s, !rows->count || (decoder ? decoder->width : channels) == gss_width(&next->scene, attribute), "R-4.6-7");
    NEED(s, step > 0 && step < 1e6f, "R-4.6-8");
    if (rows->pattern) {
        count = 0;
        for (uint32_t k = 0; k < rows->count; k++)
            count += (rows->pattern[k] & bit) != 0;
    }
    int32_t *symbols;
    TRY(gss_symbols(s, rest_of(from, 6), count, channels, &symbols));
    double most = 0, g = 1, weight = 0;
    for (size_t i = 0; i < (size_t)count * channels; i++) {
        double size = fabs((double)symbols[i]);
        most = size > most ? size : most;
    }
    if (decoder) {
        for (uint32_t i = 0; i < decoder->latents * decoder->width; i++) {
            double size = fabs((double)decoder->weights[i]);
            weight = size > weight ? size : weight;
        }
        g = decoder->latents * weight;
    }
    NEED(s, most * step * g <= 1e18, "R-4.6-9");
    apply_symbols(next, rows, attribute, bit, decoder, channels, symbols, count, step);
    return 1;
}

int gss_residual(gss_stream *s, const packet *p, state *next, uint8_t *touched)
{
    opened rows;
    int sent[ATTRIBUTES] = {0};
    int32_t bit = 1;
    TRY(open_rows(s, *gss_section(p, GATES), &next->scene, &rows));
    TRY(read_pattern(s, p, &rows));
    TRY(read_decoders(s, p, next->decoders, sent));
    for (unsigned a = 0; a < ATTRIBUTES; a++) {
        const span *section = gss_section(p, MEANS + a);
        NEED(s, section || !sent[a], "R-4.6-3");
        if (!section)
            continue;
        TRY(apply_attribute(s, *section, next, &rows, a, bit, sent[a]));
        bit *= 2;
    }
    for (uint32_t k = 0; k < rows.count; k++)
        touched[rows.row[k]] = 1;
    return 1;
}
