/* The hash of a frame: section 0.5, FIPS 180-4. */
#include "decoder.h"

typedef struct {
    uint32_t h[8];
    uint8_t waiting[64];
    uint64_t size;
} sha256;

static uint32_t turned(uint32_t v, unsigned by) { return v >> by | v << (32 - by); }

static void compress(sha256 *state_of, const uint8_t *at)
{
    static const uint32_t k[64] = {
        0x428a2f98, 0x71374491, 0xb5c0fbcf, 0xe9b5dba5, 0x3956c25b, 0x59f111f1, 0x923f82a4, 0xab1c5ed5,
        0xd807aa98, 0x12835b01, 0x243185be, 0x550c7dc3, 0x72be5d74, 0x80deb1fe, 0x9bdc06a7, 0xc19bf174,
        0xe49b69c1, 0xefbe4786, 0x0fc19dc6, 0x240ca1cc, 0x2de92c6f, 0x4a7484aa, 0x5cb0a9dc, 0x76f988da,
        0x983e5152, 0xa831c66d, 0xb00327c8, 0xbf597fc7, 0xc6e00bf3, 0xd5a79147, 0x06ca6351, 0x14292967,
        0x27b70a85, 0x2e1b2138, 0x4d2c6dfc, 0x53380d13, 0x650a7354, 0x766a0abb, 0x81c2c92e, 0x92722c85,
        0xa2bfe8a1, 0xa81a664b, 0xc24b8b70, 0xc76c51a3, 0xd192e819, 0xd6990624, 0xf40e3585, 0x106aa070,
        0x19a4c116, 0x1e376c08, 0x2748774c, 0x34b0bcb5, 0x391c0cb3, 0x4ed8aa4a, 0x5b9cca4f, 0x682e6ff3,
        0x748f82ee, 0x78a5636f, 0x84c87814, 0x8cc70208, 0x90befffa, 0xa4506ceb, 0xbef9a3f7, 0xc67178f2,
    };
    uint32_t w[64], v[8];
    for (int i = 0; i < 16; i++, at += 4)
        w[i] = (uint32_t)at[0] << 24 | (uint32_t)at[1] << 16 | (uint32_t)at[2] << 8 | at[3];
    for (int i = 16; i < 64; i++)
        w[i] = (turned(w[i - 2], 17) ^ turned(w[i - 2], 19) ^ w[i - 2] >> 10) + w[i - 7] +
               (turned(w[i - 15], 7) ^ turned(w[i - 15], 18) ^ w[i - 15] >> 3) + w[i - 16];
    memcpy(v, state_of->h, sizeof v);
    for (int i = 0; i < 64; i++) {
        uint32_t one = v[7] + (turned(v[4], 6) ^ turned(v[4], 11) ^ turned(v[4], 25)) +
                       ((v[4] & v[5]) ^ (~v[4] & v[6])) + k[i] + w[i];
        uint32_t two = (turned(v[0], 2) ^ turned(v[0], 13) ^ turned(v[0], 22)) +
                       ((v[0] & v[1]) ^ (v[0] & v[2]) ^ (v[1] & v[2]));
        memmove(v + 1, v, 7 * sizeof *v);
        v[4] += one;
        v[0] = one + two;
    }
    for (int i = 0; i < 8; i++)
        state_of->h[i] += v[i];
}

static void put(sha256 *state_of, uint8_t byte)
{
    state_of->waiting[state_of->size++ % 64] = byte;
    if (state_of->size % 64 == 0)
        compress(state_of, state_of->waiting);
}

void gss_hash(const gss_frame *frame, char digits[65])
{
    sha256 all = {{0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a, 0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19},
                  {0}, 0};
    for (unsigned a = 0; a < ATTRIBUTES; a++) {
        const float *value = gss_column(frame, a);
        uint64_t count = (uint64_t)frame->rows * gss_width(frame, a);
        for (uint64_t i = 0; i < count; i++) {
            uint32_t bits_of;
            memcpy(&bits_of, value + i, 4);
            for (unsigned byte = 0; byte < 4; byte++)
                put(&all, (uint8_t)(bits_of >> 8 * byte));
        }
    }
    uint64_t length = all.size * 8;
    put(&all, 0x80);
    while (all.size % 64 != 56)
        put(&all, 0);
    for (int byte = 7; byte >= 0; byte--)
        put(&all, (uint8_t)(length >> 8 * byte));
    for (int i = 0; i < 64; i++)
        digits[i] = "0123456789abcdef"[all.h[i / 8] >> (28 - 4 * (i % 8)) & 15];
    digits[64] = 0;
}
