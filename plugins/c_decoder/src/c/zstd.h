/* The codes of Zstandard: what zstd.c takes from entropy.c. Functions that return int return 0 for a fault. */
#ifndef GSS_ZSTD_H
#define GSS_ZSTD_H

#include "decoder.h"

/* Bits that are read from the end of a byte string to its beginning. left is below 0 once too many were read. */
typedef struct {
    span from;
    int64_t left;
} backward;

typedef struct {
    int known;
    unsigned bits; /* a table has 2^bits states */
    uint8_t symbol[512], width[512];
    uint16_t base[512];
} fse;

typedef struct {
    unsigned bits; /* 0: there is no tree */
    uint8_t symbol[1 << 11], width[1 << 11];
} huffman;

extern const uint8_t gss_code_limits[3][2]; /* most bits and largest symbol: literal lengths, offsets, match lengths */

int gss_open_backward(backward *b, span from);
uint32_t gss_read_backward(backward *b, unsigned width);
int gss_read_code(span *from, unsigned most_bits, unsigned most_symbol, fse *out);
void gss_usual_code(unsigned which, fse *out);
int gss_constant_code(unsigned which, unsigned symbol, fse *out);
uint32_t gss_code_value(unsigned which, unsigned symbol, backward *b);
int gss_read_tree(span *from, huffman *out);
int gss_decode_tree(const huffman *tree, span from, uint8_t *out, uint32_t count);

#endif
