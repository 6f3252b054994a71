/* One frame of Zstandard, of at most a mebibyte: RFC 8878. The blocks; entropy.c has the codes. */
#include "zstd.h"

enum { MOST_BLOCK = 1 << 17 };

typedef struct {
    gss_stream *s;
    uint8_t *out;
    uint32_t size, at, most; /* bytes of the content, written, and the most of a block */
    uint8_t *literals;       /* MOST_BLOCK */
    uint32_t literal_count;
    huffman tree;
    fse codes[3];            /* literal lengths, offsets, match lengths */
    uint32_t offset[3];
} unpacker;

#define FAULTY "R-3.2-3"

static int raw_literals(unpacker *z, span *from, int repeated)
{
    const uint8_t *b = from->at;
    unsigned format = b[0] >> 2 & 3, head = format == 1 ? 2 : format == 3 ? 3 : 1;
    NEED(z->s, from->size >= head, FAULTY);
    uint32_t count = head == 1 ? b[0] >> 3 : b[0] >> 4 | (uint32_t)b[1] << 4;
    if (head == 3)
        count |= (uint32_t)b[2] << 12;
    *from = rest_of(*from, head);
    uint32_t used = repeated ? 1 : count;
    NEED(z->s, count <= z->most && used <= from->size, FAULTY);
    if (repeated)
        memset(z->literals, from->at[0], count);
    else
        gss_copy(z->literals, from->at, count);
    z->literal_count = count;
    *from = rest_of(*from, used);
    return 1;
}

static int coded_literals(unpacker *z, span *from, int with_tree)
{
    unsigned format = from->at[0] >> 2 & 3, head = format < 2 ? 3 : format + 2, width = format < 2 ? 10 : 4 * format + 6;
    uint64_t fields = 0;
    NEED(z->s, from->size >= head, FAULTY);
    for (unsigned i = 0; i < head; i++)
        fields |= (uint64_t)from->at[i] << 8 * i;
    uint32_t mask = (1u << width) - 1, count = (uint32_t)(fields >> 4) & mask;
    uint32_t packed = (uint32_t)(fields >> (4 + width)) & mask;
    *from = rest_of(*from, head);
    NEED(z->s, count <= z->most && packed <= from->size, FAULTY);
    span coded = {from->at, packed};
    *from = rest_of(*from, packed);
    if (with_tree)
        NEED(z->s, gss_read_tree(&coded, &z->tree), FAULTY);
    NEED(z->s, z->tree.bits, FAULTY);
    z->literal_count = count;
    if (format == 0) {
        NEED(z->s, gss_decode_tree(&z->tree, coded, z->literals, count), FAULTY);
        return 1;
    }
    NEED(z->s, coded.size >= 6, FAULTY);
    const uint8_t *sizes = coded.at;
    uint32_t each = (count + 3) / 4, done = 0;
    coded = rest_of(coded, 6);
    NEED(z->s, 3 * each <= count, FAULTY);
    for (unsigned i = 0; i < 4; i++) {
        span stream = {coded.at, i < 3 ? u16_at(sizes + 2 * i) : coded.size};
        uint32_t here = i < 3 ? each : count - done;
        NEED(z->s, stream.size <= coded.size, FAULTY);
        NEED(z->s, gss_decode_tree(&z->tree, stream, z->literals + done, here), FAULTY);
        coded = rest_of(coded, stream.size);
        done += here;
    }
    return 1;
}

static int read_codes(unpacker *z, span *from, unsigned modes)
{
    for (unsigned i = 0; i < 3; i++) {
        unsigned mode = modes >> (6 - 2 * i) & 3;
        if (mode == 0)
            gss_usual_code(i, &z->codes[i]);
        else if (mode == 1) {
            NEED(z->s, from->size >= 1 && gss_constant_code(i, from->at[0], &z->codes[i]), FAULTY);
            *from = rest_of(*from, 1);
        } else if (mode == 2)
            NEED(z->s, gss_read_code(from, gss_code_limits[i][0], gss_code_limits[i][1], &z->codes[i]), FAULTY);
        else
            NEED(z->s, z->codes[i].known, FAULTY);
    }
    return 1;
}

/* The distance that an offset value means, 0 for a fault. */
static uint32_t distance(unpacker *z, uint32_t value, uint32_t literals)
{
    uint32_t *o = z->offset, found;
    if (value > 3) {
        found = value - 3;
        o[2] = o[1];
    } else {
        unsigned which = value - 1 + (literals == 0);
        found = which < 3 ? o[which] : o[0] - 1;
        if (which == 0)
            return found;
        if (which != 1)
            o[2] = o[1];
    }
    o[1] = o[0];
    o[0] = found;
    return found;
}

static int copy_sequence(unpacker *z, uint32_t *used, uint32_t limit, const uint32_t sequence[3])
{
    uint32_t literals = sequence[0], length = sequence[2];
    NEED(z->s, literals <= z->literal_count - *used, FAULTY);
    NEED(z->s, literals <= limit - z->at && length <= limit - z->at - literals, FAULTY);
    gss_copy(z->out + z->at, z->literals + *used, literals);
    z->at += literals;
    *used += literals;
    uint32_t back = distance(z, sequence[1], literals);
    NEED(z->s, back && back <= z->at, FAULTY);
    for (uint32_t i = 0; i < length; i++, z->at++)
        z->out[z->at] = z->out[z->at - back];
    return 1;
}

static int sequences(unpacker *z, span from, uint32_t limit)
{
    uint32_t used = 0, count, head = 1;
    NEED(z->s, from.size >= 1, FAULTY);
    count = from.at[0];
    if (count >= 128) {
        head = count < 255 ? 2 : 3;
        NEED(z->s, from.size >= head, FAULTY);
        count = head == 2 ? (count - 128) << 8 | from.at[1] : u16_at(from.at + 1) + 0x7F00;
    }
    from = rest_of(from, head);
    if (!count)
        NEED(z->s, from.size == 0, FAULTY);
    else {
        NEED(z->s, from.size >= 1 && !(from.at[0] & 3), FAULTY);
        unsigned modes = from.at[0];
        from = rest_of(from, 1);
        TRY(read_codes(z, &from, modes));
        backward b;
        uint32_t at[3];
        NEED(z->s, gss_open_backward(&b, from), FAULTY);
        for (unsigned i = 0; i < 3; i++)
            at[i] = gss_read_backward(&b, z->codes[i].bits);
        for (uint32_t i = 0; i < count; i++) {
            static const uint8_t reading[3] = {1, 2, 0}, moving[3] = {0, 2, 1};
            uint32_t sequence[3];
            for (unsigned j = 0; j < 3; j++) {
                unsigned which = reading[j];
                sequence[which] = gss_code_value(which, z->codes[which].symbol[at[which]], &b);
            }
            NEED(z->s, b.left >= 0, FAULTY);
            TRY(copy_sequence(z, &used, limit, sequence));
            for (unsigned j = 0; j < 3 && i + 1 < count; j++) {
                const fse *code = &z->codes[moving[j]];
                uint32_t now = at[moving[j]];
                at[moving[j]] = code->base[now] + gss_read_backward(&b, code->width[now]);
            }
        }
        NEED(z->s, b.left == 0, FAULTY);
    }
    uint32_t rest = z->literal_count - used;
    NEED(z->s, rest <= limit - z->at, FAULTY);
    gss_copy(z->out + z->at, z->literals + used, rest);
    z->at += rest;
    return 1;
}

static int block_of(unpacker *z, span from, unsigned type, uint32_t size)
{
    uint32_t limit = z->size - z->at < z->most ? z->size : z->at + z->most;
    if (type < 2) {
        NEED(z->s, size <= limit - z->at, FAULTY);
        if (type == 0)
            gss_copy(z->out + z->at, from.at, size);
        else
            memset(z->out + z->at, from.at[0], size);
        z->at += size;
        return 1;
    }
    NEED(z->s, from.size >= 1, FAULTY);
    unsigned literals = from.at[0] & 3;
    if (literals < 2)
        TRY(raw_literals(z, &from, (int)literals));
    else
        TRY(coded_literals(z, &from, literals == 2));
    return sequences(z, from, limit);
}

/* The head of the frame; *from goes on to the first block. */
static int read_head(unpacker *z, span *from, int *checksum)
{
    NEED(z->s, from->size >= 5 && u32_at(from->at) == 0xFD2FB528, "R-3.2-1");
    unsigned flags = from->at[4], single = flags >> 5 & 1, size_flag = flags >> 6;
    unsigned sized = size_flag ? 1u << size_flag : single, at = 5, named = (1u << (flags & 3)) >> 1;
    NEED(z->s, !(flags & 8), FAULTY);
    NEED(z->s, sized, "R-3.2-2");
    NEED(z->s, from->size >= 5 + (single ? 0 : 1) + named + sized, FAULTY);
    uint64_t window = 0, size = 0;
    if (!single) {
        unsigned b = from->at[at++];
        window = ((uint64_t)1 << (10 + (b >> 3)));
        window += window / 8 * (b & 7);
    }
    for (; named; named--)
        NEED(z->s, from->at[at++] == 0, "R-3.2-2");
    for (unsigned i = 0; i < sized; i++)
        size |= (uint64_t)from->at[at++] << 8 * i;
    size += sized == 2 ? 256 : 0;
    NEED(z->s, size <= MOST_META, "R-3.2-3");
    NEED(z->s, size >= 2, "R-3.2-4");
    window = single ? size : window;
    z->size = (uint32_t)size;
    z->most = window < MOST_BLOCK ? (uint32_t)window : MOST_BLOCK;
    *checksum = flags >> 2 & 1;
    *from = rest_of(*from, at);
    return 1;
}

int gss_unpack(gss_stream *s, span frame, region *keep, uint8_t **content, uint32_t *length)
{
    unpacker *z = gss_zeros(s, &s->scratch, 1, sizeof *z);
    int checksum = 0, last = 0;
    TRY(z);
    z->s = s;
    z->offset[0] = 1;
    z->offset[1] = 4;
    z->offset[2] = 8;
    TRY(read_head(z, &frame, &checksum));
    TRY(z->literals = gss_take(s, &s->scratch, MOST_BLOCK, 1));
    TRY(z->out = gss_take(s, keep, (uint64_t)z->size + 1, 1));
    while (!last) {
        NEED(s, frame.size >= 3, FAULTY);
        uint32_t head = u16_at(frame.at) | (uint32_t)frame.at[2] << 16, size = head >> 3;
        unsigned type = head >> 1 & 3;
        last = head & 1;
        frame = rest_of(frame, 3);
        uint32_t stored = type == 1 ? 1 : size;
        NEED(s, type < 3 && size <= z->most && stored <= frame.size, FAULTY);
        span inside = {frame.at, stored};
        TRY(block_of(z, inside, type, size));
        frame = rest_of(frame, stored);
    }
    uint32_t behind = checksum ? 4 : 0;
    NEED(s, z->at == z->size && frame.size >= behind, FAULTY);
    NEED(s, frame.size == behind, "R-3.2-1");
    z->out[z->size] = 0;
    *content = z->out;
    *length = z->size;
    return 1;
}
