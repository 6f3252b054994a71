/* Decode streams that were changed at random places and signed again, so that the faults reach the decoder.
 *
 *     mutants FIRST COUNT STREAM [STREAM ...]     decode COUNT mutants from number FIRST on, and examine each
 *     mutants FIRST -1 STREAM                     write mutant FIRST to standard output
 *
 * Whatever the bytes are, frames must follow each other, hold finite values and as many rows as their nodes; frames
 * before the first changed byte must be those of the stream; a refusal must leave the last frame as it is; and no
 * mutant may take ten seconds of the processor. Tools that watch memory and arithmetic must have nothing to say. Compiled
 * with -DLIBFUZZER -fsanitize=fuzzer the same is asked of inputs that libFuzzer looks for.
 */
#define _XOPEN_SOURCE 600
#include "../src/c/decoder.h"

#include <stdio.h>
#include <stdlib.h>
#include <sys/time.h>

enum { FRAMES = 256 };

/* What the frames of a stream are, and where the packets of those that are played end. */
typedef struct {
    size_t frames, end[FRAMES];
    char digits[FRAMES][65];
} expected;

typedef struct {
    uint64_t frames, refused, played, without_memory;
} counts;

static void must(int holds, const char *what)
{
    if (!holds) {
        fprintf(stderr, "wrong: %s\n", what);
        abort();
    }
}

static void examine(const gss_frame *f)
{
    const float *values[] = {f->means, f->quats, f->scales, f->opacities, f->sh0, f->shN};
    const size_t widths[] = {3, 4, 3, 1, 3, 3 * (size_t)f->harmonics};
    for (int a = 0; a < ATTRIBUTES; a++)
        for (size_t i = 0; i < widths[a] * f->rows; i++)
            must(isfinite(values[a][i]), "a value is not finite");
    uint64_t rows = 0;
    for (uint32_t node = 0; node < f->nodes; node++)
        rows += f->node_counts[node];
    must(rows == f->rows, "the nodes hold another number of rows");
    for (uint32_t row = 0; f->displaced && row < f->rows; row++)
        must(f->displaced[row] <= 1 && isfinite(f->rotations[3 * row]), "a displacement is none");
}

/* Decode all of a stream. Frames that end at or before byte same must be those of before. */
static void decode(const uint8_t *bytes, size_t size, const expected *before, size_t same, counts *total)
{
    gss_stream *stream = gss_open(bytes, size, 1 << 28);
    must(stream != NULL, "there is no memory at all");
    int found;
    size_t number = 0;
    uint32_t index = 0;
    char digits[65] = "", after[65];
    while ((found = gss_next(stream)) == GSS_FRAME) {
        const gss_frame *f = gss_state(stream);
        must(number == 0 || f->frame == index + 1, "a frame does not follow the one before");
        index = f->frame;
        examine(f);
        gss_hash(f, digits);
        if (before && number < before->frames && before->end[number] <= same)
            must(!strcmp(digits, before->digits[number]), "a frame before the change is another one");
        number++;
    }
    if (before)
        must(number >= before->frames || before->end[number] > same || found == GSS_NO_MEMORY,
             "a sound frame is missing");
    if (number) {
        gss_hash(gss_state(stream), after);
        must(!strcmp(digits, after), "a refusal changed the last frame");
    }
    must(gss_next(stream) == found, "the end does not stay");
    must(found != GSS_REFUSED || (gss_error(stream)->rule[0] && gss_error(stream)->byte <= size),
         "a refusal without its place");
    total->frames += number;
    total->refused += found == GSS_REFUSED;
    total->played += found == GSS_END;
    total->without_memory += found == GSS_NO_MEMORY;
    gss_close(stream);
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

#ifndef LIBFUZZER

static void expect(const uint8_t *bytes, size_t size, expected *out)
{
    out->frames = 0;
    gss_stream *stream = gss_open(bytes, size, 0);
    size_t end = 16;
    while (stream && gss_next(stream) == GSS_FRAME && out->frames < FRAMES) {
        end += 16 + (size_t)u32_at(bytes + end + 8);
        out->end[out->frames] = end;
        gss_hash(gss_state(stream), out->digits[out->frames++]);
    }
    gss_close(stream);
}

static uint64_t random_state;

static uint32_t draw(uint32_t below)
{
    random_state ^= random_state << 13;
    random_state ^= random_state >> 7;
    random_state ^= random_state << 17;
    return (uint32_t)((random_state >> 32) % below);
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

typedef struct {
    uint8_t *bytes;
    size_t size;
    expected plays;
} seed;

static void read_seed(const char *path, seed *out)
{
    FILE *file = fopen(path, "rb");
    out->bytes = malloc(1 << 20);
    if (!file || !out->bytes)
        exit(3);
    out->size = fread(out->bytes, 1, 1 << 20, file);
    fclose(file);
    expect(out->bytes, out->size, &out->plays);
}

int main(int words_count, char **words)
{
    if (words_count < 4)
        return 3;
    uint64_t first = strtoull(words[1], NULL, 10), seeds = (uint64_t)words_count - 3;
    long many = strtol(words[2], NULL, 10);
    counts total = {0, 0, 0, 0};
    seed *all = calloc(seeds, sizeof *all);
    if (!all)
        return 3;
    for (uint64_t i = first; i < first + (uint64_t)(many < 0 ? 1 : many); i++) {
        seed *from = all + i % seeds;
        if (!from->bytes)
            read_seed(words[3 + i % seeds], from);
        uint8_t *bytes = mutant(from->bytes, from->size, i);
        if (many < 0) {
            fwrite(bytes, 1, from->size, stdout);
        } else {
            struct itimerval most = {{0, 0}, {10, 0}};
            setitimer(ITIMER_PROF, &most, NULL); /* whoever is late ends by SIGPROF */
            fprintf(stderr, "\rmutant %llu ", (unsigned long long)i);
            size_t same = 0;
            while (same < from->size && bytes[same] == from->bytes[same])
                same++;
            decode(bytes, from->size, &from->plays, same, &total);
        }
        free(bytes);
    }
    for (uint64_t i = 0; i < seeds; i++)
        free(all[i].bytes);
    free(all);
    if (many >= 0)
        printf("%llu frames, %llu refused, %llu played, %llu without memory\n", (unsigned long long)total.frames,
               (unsigned long long)total.refused, (unsigned long long)total.played,
               (unsigned long long)total.without_memory);
    return 0;
}

#else

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t size);
size_t LLVMFuzzerCustomMutator(uint8_t *bytes, size_t size, size_t room, unsigned seed);
size_t LLVMFuzzerMutate(uint8_t *bytes, size_t size, size_t room);

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t size)
{
    static counts total;
    decode(bytes, size, NULL, 0, &total);
    return 0;
}

size_t LLVMFuzzerCustomMutator(uint8_t *bytes, size_t size, size_t room, unsigned seed)
{
    size = LLVMFuzzerMutate(bytes, size, room);
    if (seed % 16)
        sign(bytes, size);
    return size;
}

#endif
