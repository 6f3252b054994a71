/* Finite state entropy and Huffman codes: sections 4.1 and 4.2 of RFC 8878. */
#include "zstd.h"

enum { LITERAL_LENGTHS = 0, OFFSETS = 1, MATCH_LENGTHS = 2 };

const uint8_t gss_code_limits[3][2] = {{9, 35}, {8, 31}, {9, 52}};

static unsigned highest_bit(uint32_t v)
{
    unsigned found = 0;
    while (v >>= 1)
        found++;
    return found;
}

int gss_open_backward(backward *b, span from)
{
    if (!from.size || !from.at[from.size - 1])
        return 0;
    b->from = from;
    b->left = (int64_t)(from.size - 1) * 8 + highest_bit(from.at[from.size - 1]);
    return 1;
}

/* width bits, at most 31, that end before bit b->left; bits before the first are 0. */
static uint32_t peek(const backward *b, unsigned width)
{
    int64_t begin = b->left - width, first = begin < 0 ? 0 : begin;
    if (b->left <= 0 || !width)
        return 0;
    uint64_t found = 0;
    size_t byte = (size_t)(first >> 3);
    for (unsigned i = 0; i < 5 && byte + i < b->from.size; i++)
        found |= (uint64_t)b->from.at[byte + i] << 8 * i;
    found >>= first & 7;
    found &= ((uint64_t)1 << (b->left - first)) - 1;
    return (uint32_t)(found << (first - begin));
}

uint32_t gss_read_backward(backward *b, unsigned width)
{
    uint32_t found = peek(b, width);
    b->left -= width;
    return found;
}

/* A table of the probabilities; -1 stands for "below one". They sum up to the number of states. */
static void build(const int16_t *probability, unsigned symbols, unsigned bits, fse *out)
{
    uint32_t size = 1u << bits, high = size, at = 0, step = (size >> 1) + (size >> 3) + 3;
    uint16_t next[256];
    out->known = 1;
    out->bits = bits;
    for (unsigned i = 0; i < symbols; i++) {
        next[i] = (uint16_t)(probability[i] < 0 ? 1 : probability[i]);
        if (probability[i] < 0)
            out->symbol[--high] = (uint8_t)i;
    }
    for (unsigned i = 0; i < symbols; i++)
        for (int k = 0; k < probability[i]; k++) {
            out->symbol[at] = (uint8_t)i;
            do
                at = (at + step) & (size - 1);
            while (at >= high);
        }
    for (uint32_t i = 0; i < size; i++) {
        uint32_t value = next[out->symbol[i]]++;
        unsigned width = bits - highest_bit(value);
        out->width[i] = (uint8_t)width;
        out->base[i] = (uint16_t)((value << width) - size);
    }
}

/* Forward bits, the least significant first; 0 behind the end, which the caller tests. */
static uint32_t forward(span from, uint32_t *bit, unsigned width)
{
    uint32_t found = 0;
    for (unsigned i = 0; i < width; i++, (*bit)++)
        if (*bit / 8 < from.size)
            found |= (uint32_t)(from.at[*bit / 8] >> (*bit % 8) & 1) << i;
    return found;
}

int gss_read_code(span *from, unsigned most_bits, unsigned most_symbol, fse *out)
{
    int16_t probability[256] = {0};
    uint32_t bit = 0;
    unsigned bits = 5 + forward(*from, &bit, 4), symbols = 0;
    if (bits > most_bits)
        return 0;
    int32_t left = 1 << bits;
    while (left > 0) {
        if (symbols > most_symbol || bit > from->size * 8)
            return 0;
        unsigned width = highest_bit((uint32_t)left + 1) + 1;
        uint32_t value = forward(*from, &bit, width), low = (1u << (width - 1)) - 1;
        uint32_t threshold = (1u << width) - 1 - ((uint32_t)left + 1);
        if ((value & low) < threshold) {
            bit--;
            value &= low;
        } else if (value > low)
            value -= threshold;
        int32_t here = (int32_t)value - 1;
        left -= here < 0 ? 1 : here;
        probability[symbols++] = (int16_t)here;
        for (uint32_t zeros = here == 0 ? 3 : 0; zeros == 3;) {
            zeros = forward(*from, &bit, 2);
            symbols += zeros;
            if (symbols > most_symbol + 1)
                return 0;
        }
    }
    uint32_t bytes = (bit + 7) / 8;
    if (left || bytes > from->size)
        return 0;
    build(probability, symbols, bits, out);
    *from = rest_of(*from, bytes);
    return 1;
}

void gss_usual_code(unsigned which, fse *out)
{
    static const int16_t literal_lengths[36] = {4, 3, 2, 2, 2, 2, 2, 2, 2, 2, 2, 2, 2, 1, 1, 1, 2, 2,
                                                2, 2, 2, 2, 2, 2, 2, 3, 2, 1, 1, 1, 1, 1, -1, -1, -1, -1};
    static const int16_t offsets[29] = {1, 1, 1, 1, 1, 1, 2, 2, 2, 1, 1, 1, 1, 1, 1,
                                        1, 1, 1, 1, 1, 1, 1, 1, 1, -1, -1, -1, -1, -1};
    static const int16_t match_lengths[53] = {1, 4, 3, 2, 2, 2, 2, 2, 2, 1, 1, 1, 1, 1, 1, 1, 1, 1,
                                              1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1,
                                              1, 1, 1, 1, 1, 1, 1, 1, 1, 1, -1, -1, -1, -1, -1, -1, -1};
    if (which == LITERAL_LENGTHS)
        build(literal_lengths, 36, 6, out);
    else if (which == OFFSETS)
        build(offsets, 29, 5, out);
    else
        build(match_lengths, 53, 6, out);
}

int gss_constant_code(unsigned which, unsigned symbol, fse *out)
{
    out->known = 1;
    out->bits = 0;
    out->symbol[0] = (uint8_t)symbol;
    out->width[0] = 0;
    out->base[0] = 0;
    return symbol <= gss_code_limits[which][1];
}

uint32_t gss_code_value(unsigned which, unsigned symbol, backward *b)
{
    static const uint8_t more[2][21] = {
        {1, 1, 1, 1, 2, 2, 3, 3, 4, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16},
        {1, 1, 1, 1, 2, 2, 3, 3, 4, 4, 5, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16},
    };
    if (which == OFFSETS)
        return ((uint32_t)1 << symbol) + gss_read_backward(b, symbol);
    unsigned matches = which == MATCH_LENGTHS, plain = matches ? 32 : 16;
    uint32_t base = matches ? 3 : 0;
    if (symbol < plain)
        return symbol + base;
    base += plain;
    for (unsigned i = plain; i < symbol; i++)
        base += 1u << more[matches][i - plain];
    return base + gss_read_backward(b, more[matches][symbol - plain]);
}

/* Weights of a tree that are coded by two states in turns. */
static int coded_weights(span from, uint8_t *weight, unsigned *count)
{
    fse code;
    backward b;
    if (!gss_read_code(&from, 6, 255, &code) || !gss_open_backward(&b, from))
        return 0;
    uint32_t at[2];
    at[0] = gss_read_backward(&b, code.bits);
    at[1] = gss_read_backward(&b, code.bits);
    if (b.left < 0)
        return 0;
    for (unsigned which = 0; *count < 254; which = !which) {
        uint32_t now = at[which];
        weight[(*count)++] = code.symbol[now];
        at[which] = code.base[now] + gss_read_backward(&b, code.width[now]);
        if (b.left < 0) {
            weight[(*count)++] = code.symbol[at[!which]];
            return 1;
        }
    }
    return 0;
}

int gss_read_tree(span *from, huffman *out)
{
    uint8_t weight[256] = {0};
    unsigned count = 0, head = from->size ? from->at[0] : 0;
    uint32_t bytes = head < 128 ? head : (head - 126) / 2, sum = 0, ones = 0;
    if (!from->size || bytes > from->size - 1)
        return 0;
    *from = rest_of(*from, 1);
    if (head >= 128)
        for (; count < head - 127; count++)
            weight[count] = from->at[count / 2] >> (count % 2 ? 0 : 4) & 15;
    else if (!coded_weights((span){from->at, bytes}, weight, &count))
        return 0;
    *from = rest_of(*from, bytes);
    for (unsigned i = 0; i < count; i++) {
        if (weight[i] > 11)
            return 0;
        sum += weight[i] ? 1u << (weight[i] - 1) : 0;
    }
    unsigned bits = highest_bit(sum) + 1;
    uint32_t left = (1u << bits) - sum;
    if (!sum || bits > 11 || left & (left - 1))
        return 0;
    weight[count++] = (uint8_t)(highest_bit(left) + 1);
    uint32_t at = 0;
    for (unsigned w = 1; w <= bits; w++)
        for (unsigned i = 0; i < count; i++)
            for (uint32_t k = 0; weight[i] == w && k < 1u << (w - 1); k++, at++) {
                out->symbol[at] = (uint8_t)i;
                out->width[at] = (uint8_t)(bits + 1 - w);
                ones += w == 1;
            }
    out->bits = bits;
    return ones >= 2;
}

int gss_decode_tree(const huffman *tree, span from, uint8_t *out, uint32_t count)
{
    backward b;
    if (!gss_open_backward(&b, from))
        return 0;
    for (uint32_t i = 0; i < count; i++) {
        uint32_t at = peek(&b, tree->bits);
        out[i] = tree->symbol[at];
        b.left -= tree->width[at];
    }
    return b.left == 0;
}
