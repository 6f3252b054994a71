/* Bits, parts, symbols and gates: chapter 2. */
#include "decoder.h"

int gss_field(gss_stream *s, bits *b, unsigned width, uint64_t *value)
{
    NEED(s, b->bit + width <= (uint64_t)b->from.size * 8, "R-2.1-1");
    uint64_t found = 0;
    while (width) {
        unsigned left = 8 - (unsigned)(b->bit & 7), take = width < left ? width : left;
        found = found << take | ((b->from.at[b->bit >> 3] >> (left - take)) & ((1u << take) - 1));
        b->bit += take;
        width -= take;
    }
    *value = found;
    return 1;
}

int gss_gamma(gss_stream *s, bits *b, uint64_t *value)
{
    unsigned zeros = 0;
    for (;;) {
        uint64_t one;
        TRY(gss_field(s, b, 1, &one));
        if (one)
            break;
        NEED(s, ++zeros < 36, "R-2.1-2");
    }
    uint64_t low;
    TRY(gss_field(s, b, zeros, &low));
    *value = (((uint64_t)1 << zeros) | low) - 1;
    return 1;
}

int gss_signed(gss_stream *s, bits *b, int64_t *value)
{
    uint64_t found;
    TRY(gss_gamma(s, b, &found));
    *value = found & 1 ? -(int64_t)((found + 1) / 2) : (int64_t)(found / 2);
    return 1;
}

int gss_end_of_bits(gss_stream *s, const bits *b, const char *rule)
{
    uint64_t left = (uint64_t)b->from.size * 8 - b->bit;
    NEED(s, left < 8, rule);
    NEED(s, !left || !(b->from.at[b->from.size - 1] & ((1u << left) - 1)), rule);
    return 1;
}

int gss_parts(gss_stream *s, span from, unsigned count, span *parts)
{
    for (unsigned i = 0; i + 1 < count; i++) {
        uint64_t length = 0;
        for (unsigned byte = 0;; byte++) {
            NEED(s, byte < 5, "R-2.2-1");
            NEED(s, from.size > 0, "R-2.2-2");
            uint8_t here = *from.at;
            from = rest_of(from, 1);
            length |= (uint64_t)(here & 127) << (7 * byte);
            if (here < 128)
                break;
        }
        NEED(s, length <= from.size, "R-2.2-2");
        parts[i].at = from.at;
        parts[i].size = (uint32_t)length;
        from = rest_of(from, (uint32_t)length);
    }
    parts[count - 1] = from;
    return 1;
}

typedef struct {
    int64_t low;
    uint32_t bins, entries;
    uint32_t *left; /* [entries + 1] */
} model;

/* One count: the number of its bits follows that of the count before. */
static int read_count(gss_stream *s, bits *b, int64_t *length, uint64_t *count)
{
    int64_t change;
    TRY(gss_signed(s, b, &change));
    *length += change;
    NEED(s, *length >= 0 && *length <= 32, "R-2.4-3");
    *count = 0;
    if (*length == 0)
        return 1;
    unsigned t = *length - 1 < 2 ? (unsigned)(*length - 1) : 2, r = (unsigned)(*length - 1) - t;
    uint64_t field;
    TRY(gss_field(s, b, t, &field));
    *count = (((uint64_t)1 << t) + field) << r;
    if (r)
        *count += (uint64_t)1 << (r - 1);
    return 1;
}

static int read_model(gss_stream *s, bits *b, model *m)
{
    uint64_t bins, escape;
    TRY(gss_signed(s, b, &m->low));
    TRY(gss_gamma(s, b, &bins));
    bins += 1;
    NEED(s, bins <= 16384, "R-2.4-1");
    NEED(s, m->low >= -2147483648LL && m->low + (int64_t)bins <= 2147483648LL, "R-2.4-2");
    TRY(gss_field(s, b, 1, &escape));
    m->bins = (uint32_t)bins;
    m->entries = m->bins + (uint32_t)escape;
    m->left = NULL;
    if (m->entries == 1)
        return 1;
    NEED(s, m->entries <= (uint64_t)b->from.size * 8 - b->bit, "R-2.1-1"); /* a count has at least one bit */
    uint64_t *count = gss_take(s, &s->scratch, m->entries, sizeof *count);
    TRY(count);
    TRY(m->left = gss_take(s, &s->scratch, m->entries + 1, sizeof *m->left));
    int64_t length = 0;
    uint64_t sum = 0, before = 0;
    for (uint32_t i = 0; i < m->entries; i++) {
        TRY(read_count(s, b, &length, &count[i]));
        sum += count[i];
    }
    NEED(s, sum > 0, "R-2.4-4");
    double scale = (16777216.0 - m->entries) / (double)sum;
    for (uint32_t i = 0; i < m->entries; i++) {
        m->left[i] = (uint32_t)((double)before * scale) + i;
        before += count[i];
    }
    m->left[m->entries] = 1u << 24;
    return 1;
}

enum { FINE = 14, COARSE = 1 << (24 - FINE) };

/* For each 2^14 of the integers the entry that holds the first of them. */
static void index_model(const model *m, uint16_t *entry)
{
    uint32_t i = 0;
    for (uint32_t k = 0; k < COARSE; k++) {
        while (m->left[i + 1] <= k << FINE)
            i++;
        entry[k] = (uint16_t)i;
    }
    entry[COARSE] = (uint16_t)(m->entries - 1);
}

static uint32_t entry_of(const model *m, const uint16_t *entry, uint32_t x)
{
    uint32_t low = entry[x >> FINE], high = entry[(x >> FINE) + 1];
    while (low < high) {
        uint32_t middle = (low + high + 1) / 2;
        if (m->left[middle] <= x)
            low = middle;
        else
            high = middle - 1;
    }
    return low;
}

typedef struct {
    uint64_t state;
    const uint8_t *bytes;
    uint32_t words; /* that are left */
} coder;

static void refill(coder *c)
{
    if (c->state < (uint64_t)1 << 32 && c->words)
        c->state = c->state << 32 | u32_at(c->bytes + 4 * (size_t)--c->words);
}

static int escaped(gss_stream *s, bits *b, const model *m, int32_t *value)
{
    uint64_t below, d;
    TRY(gss_field(s, b, 1, &below));
    TRY(gss_gamma(s, b, &d));
    int64_t found = below ? m->low - 1 - (int64_t)d : m->low + m->bins + (int64_t)d;
    NEED(s, found >= -2147483648LL && found <= 2147483647LL, "R-2.7-1");
    *value = (int32_t)found;
    return 1;
}

static int decode(gss_stream *s, span words, bits *head, const model *models, int shared, uint32_t rows,
                  uint32_t channels, int32_t *out)
{
    uint16_t entry[COARSE + 1];
    NEED(s, words.size % 4 == 0, "R-2.6-1");
    NEED(s, !words.size || u32_at(words.at + words.size - 4), "R-2.6-2");
    coder c = {0, words.at, words.size / 4};
    while (c.state < (uint64_t)1 << 32 && c.words)
        refill(&c);
    for (uint32_t channel = 0; channel < channels; channel++, out += rows) {
        const model *m = shared ? models : models + channel;
        if (m->entries == 1) {
            for (uint32_t row = 0; row < rows; row++)
                out[row] = (int32_t)m->low;
            continue;
        }
        if (!shared || channel == 0)
            index_model(m, entry);
        for (uint32_t row = 0; row < rows; row++) {
            uint32_t x = (uint32_t)(c.state & 0xFFFFFF), i = entry_of(m, entry, x);
            c.state = (c.state >> 24) * (m->left[i + 1] - m->left[i]) + (x - m->left[i]);
            refill(&c);
            if (i < m->bins)
                out[row] = (int32_t)(m->low + i);
            else
                TRY(escaped(s, head, m, &out[row]));
        }
    }
    NEED(s, c.state == 0 && c.words == 0, "R-2.6-3");
    return 1;
}

int gss_symbols(gss_stream *s, span from, uint32_t rows, uint32_t channels, int32_t **table)
{
    static int32_t none; /* never read or written: a place to point to */
    *table = &none;
    if (!rows || !channels) {
        NEED(s, from.size == 0, "R-2.3-1");
        return 1;
    }
    span part[2];
    TRY(gss_parts(s, from, 2, part));
    bits head = {part[0], 0};
    uint64_t shared;
    TRY(gss_field(s, &head, 1, &shared));
    uint32_t count = shared ? 1 : channels;
    model *models = gss_take(s, &s->scratch, count, sizeof *models);
    TRY(models);
    for (uint32_t i = 0; i < count; i++)
        TRY(read_model(s, &head, &models[i]));
    TRY(*table = gss_take(s, &s->scratch, (uint64_t)rows * channels, sizeof **table));
    TRY(decode(s, part[1], &head, models, (int)shared, rows, channels, *table));
    return gss_end_of_bits(s, &head, "R-2.7-2");
}

/* The lengths of all runs but the last: tokens of even runs come first, then those of odd ones. */
static int run_lengths(gss_stream *s, bits *head, const span *tokens, uint32_t sent, uint32_t entries, uint32_t *length)
{
    uint64_t sum = 0;
    for (unsigned odd = 0; odd < 2; odd++) {
        uint32_t count = odd ? sent / 2 : sent - sent / 2;
        int32_t *token;
        TRY(gss_symbols(s, tokens[odd], count, 1, &token));
        for (uint32_t i = 0; i < count; i++) {
            NEED(s, token[i] >= 0 && token[i] <= 71, "R-2.8-3");
            uint64_t v = (uint64_t)token[i];
            if (v >= 16) {
                unsigned n = 4 + (unsigned)(v - 16) / 2;
                uint64_t h = (v - 16) % 2, e;
                TRY(gss_field(s, head, n - 1, &e));
                v = ((uint64_t)1 << n) + (h << (n - 1)) + e;
            }
            sum += v + 1;
            NEED(s, sum < entries, "R-2.8-4");
            length[2 * i + odd] = (uint32_t)v + 1;
        }
    }
    return 1;
}

int gss_gates(gss_stream *s, span from, uint32_t entries, int one_level, gates *out)
{
    span part[4];
    TRY(gss_parts(s, from, 4, part));
    bits head = {part[0], 0};
    uint64_t levels, runs, open;
    TRY(gss_gamma(s, &head, &levels));
    levels += 1;
    NEED(s, levels <= 255, "R-2.8-1");
    NEED(s, levels == 1 || !one_level, "R-2.8-7");
    TRY(gss_gamma(s, &head, &runs));
    NEED(s, runs <= entries && (runs == 0) == (entries == 0), "R-2.8-2");
    TRY(gss_field(s, &head, 1, &open));
    uint32_t sent = runs ? (uint32_t)runs - 1 : 0;
    uint32_t *length = gss_take(s, &s->scratch, sent, sizeof *length);
    TRY(length);
    TRY(run_lengths(s, &head, part + 1, sent, entries, length));
    TRY(gss_end_of_bits(s, &head, "R-2.8-6"));
    TRY(out->level = gss_take(s, &s->scratch, entries, 1));
    out->levels = (uint32_t)levels;
    out->open = 0;
    for (uint32_t run = 0, at = 0; run < runs; run++, open = !open) {
        uint32_t count = run < sent ? length[run] : entries - at;
        memset(out->level + at, (int)open, count);
        out->open += open ? count : 0;
        at += count;
    }
    if (levels == 1) {
        NEED(s, part[3].size == 0, "R-2.3-1");
        return 1;
    }
    int32_t *level;
    TRY(gss_symbols(s, part[3], out->open, 1, &level));
    for (uint32_t i = 0; i < entries; i++)
        if (out->level[i]) {
            NEED(s, *level >= 1 && (uint64_t)*level <= levels, "R-2.8-5");
            out->level[i] = (uint8_t)*level++;
        }
    return 1;
}
