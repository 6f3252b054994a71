/* Decode streams that were changed at random places and signed again, so that the faults reach the decoder.
 *
 *     mutants FIRST COUNT STREAM [STREAM ...]      decode mutants FIRST to FIRST + COUNT - 1; all that is asked is that
 *                                                  no tool which watches memory and arithmetic has a word to say
 *     mutants FIRST -1 STREAM                      write mutant FIRST to standard output
 */
#include "../src/c/decoder.h"

#include <stdio.h>
#include <stdlib.h>

static uint64_t random_state;

static uint32_t draw(uint32_t below)
{
    random_state ^= random_state << 13;
    random_state ^= random_state >> 7;
    random_state ^= random_state << 17;
    return (uint32_t)((random_state >> 32) % below);
}

static void put(uint8_t *at, uint32_t value, unsigned bytes)
{
    for (unsigned i = 0; i < bytes; i++)
        at[i] = (uint8_t)(value >> 8 * i);
}

/* Checks and checksums of every packet that the headers lead to, and of first layers. */
static void sign(uint8_t *bytes, size_t size)
{
    for (size_t at = 16; at + 16 <= size;) {
        uint8_t *h = bytes + at;
        uint32_t length = u32_at(h + 8);
        if (length > size - at - 16)
            return;
        if (length >= 17 && h[16] == LAYERS && u32_at(h + 17) == 12 && length >= 33) {
            uint32_t layer = u32_at(h + 25);
            if (layer <= length - 17)
                put(h + 29, gss_crc(0, h + 33, layer), 4);
        }
        put(h + 12, gss_crc(gss_crc(gss_crc(0, h, 2), h + 4, 8), h + 16, length), 4);
        put(h + 2, gss_crc(gss_crc(0, h, 2), h + 4, 12), 2);
        at += 16 + (size_t)length;
    }
}

static uint8_t *mutant(const uint8_t *original, size_t size, uint64_t number)
{
    uint8_t *bytes = malloc(size);
    if (!bytes)
        exit(3);
    memcpy(bytes, original, size);
    random_state = number * 0x9E3779B97F4A7C15u + 0xD1B54A32D192ED03u;
    for (int i = 0; i < 8; i++)
        draw(2);
    /* One packet; the first one is often much the longest and then would take nearly all of the changes. */
    size_t packets = 0, begin = 16, chosen = 0;
    for (size_t at = 16; at + 16 <= size; at += 16 + (size_t)u32_at(bytes + at + 8), packets++)
        if (!draw((uint32_t)packets + 1))
            begin = at;
    chosen = begin + 16 <= size ? begin : 0;
    size_t length = 16 + (size_t)(chosen ? u32_at(bytes + chosen + 8) : 0);
    if (length > size - chosen)
        length = size - chosen;
    static const uint8_t extremes[] = {0, 1, 2, 15, 16, 63, 64, 127, 128, 255};
    for (uint32_t changes = 1 + draw(4); changes; changes--) {
        uint8_t *at = bytes + chosen + (draw(8) ? 16 + draw((uint32_t)(length > 16 ? length - 16 : 1)) : draw(16));
        if (at >= bytes + size)
            continue;
        uint32_t how = draw(4);
        *at = (uint8_t)(how == 0 ? draw(256) : how == 1 ? extremes[draw(10)] : how == 2 ? *at + 1 - 2 * draw(2)
                                                                                       : *at ^ 1u << draw(8));
    }
    if (draw(16))
        sign(bytes, size);
    return bytes;
}

static uint8_t *read_file(const char *path, size_t *size)
{
    FILE *file = fopen(path, "rb");
    uint8_t *bytes = malloc(1 << 20);
    if (!file || !bytes)
        exit(3);
    *size = fread(bytes, 1, 1 << 20, file);
    fclose(file);
    return bytes;
}

int main(int count, char **words)
{
    if (count < 4)
        return 3;
    uint64_t first = strtoull(words[1], NULL, 10), frames = 0, refused = 0, ended = 0, memory = 0;
    long many = strtol(words[2], NULL, 10);
    for (uint64_t i = first; i < first + (uint64_t)(many < 0 ? 1 : many); i++) {
        size_t size;
        uint8_t *original = read_file(words[3 + i % (uint64_t)(count - 3)], &size), *bytes = mutant(original, size, i);
        free(original);
        if (many < 0) {
            fwrite(bytes, 1, size, stdout);
            free(bytes);
            return 0;
        }
        gss_stream *stream = gss_open(bytes, size, 1 << 28);
        int found;
        while ((found = gss_next(stream)) == GSS_FRAME) {
            char digits[65];
            gss_hash(gss_state(stream), digits);
            frames++;
        }
        refused += found == GSS_REFUSED;
        ended += found == GSS_END;
        memory += found == GSS_NO_MEMORY;
        gss_close(stream);
        free(bytes);
    }
    printf("%llu frames, %llu refused, %llu played, %llu without memory\n", (unsigned long long)frames,
           (unsigned long long)refused, (unsigned long long)ended, (unsigned long long)memory);
    return 0;
}
