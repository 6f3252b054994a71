/* The file, packets, sections and the index: chapter 1. And the functions of gss.h. */
#include "decoder.h"

#include <stdio.h>
#include <stdlib.h>

enum { HEADER = 16, MINOR = 4 };

/* The CRC-32 of a byte, four bits at a time: reflected polynomial EDB88320. */
uint32_t gss_crc(uint32_t before, const uint8_t *bytes, size_t size)
{
    static const uint32_t table[16] = {
        0x00000000, 0x1DB71064, 0x3B6E20C8, 0x26D930AC, 0x76DC4190, 0x6B6B51F4, 0x4DB26158, 0x5005713C,
        0xEDB88320, 0xF00F9344, 0xD6D6A3E8, 0xCB61B38C, 0x9B64C2B0, 0x86D3D2D4, 0xA00AE278, 0xBDBDF21C,
    };
    uint32_t crc = ~before;
    for (size_t i = 0; i < size; i++) {
        crc ^= bytes[i];
        crc = crc >> 4 ^ table[crc & 15];
        crc = crc >> 4 ^ table[crc & 15];
    }
    return ~crc;
}

const span *gss_section(const packet *p, unsigned number)
{
    for (unsigned i = 0; i < p->sections; i++)
        if (p->number[i] == number)
            return &p->payload[i];
    return NULL;
}

static int known(unsigned number) { return (number >= META && number <= LIGHT) || (number >= MEANS && number <= SHN); }

static int check_file(gss_stream *s)
{
    static const uint8_t magic[8] = {0x89, 0x47, 0x53, 0x53, 0x0D, 0x0A, 0x1A, 0x0A};
    s->begin = 0;
    NEED(s, s->size >= HEADER && !memcmp(s->bytes, magic, 8), "R-1.1-1");
    NEED(s, gss_crc(0, s->bytes, 12) == u32_at(s->bytes + 12), "R-1.1-2");
    uint32_t major = u16_at(s->bytes + 8), minor = u16_at(s->bytes + 10);
    if (major == 2 && minor <= MINOR)
        return 1;
    char message[96];
    snprintf(message, sizeof message, "the file is of version %u.%u, and this decoder reads 2.0 to 2.%d",
             (unsigned)major, (unsigned)minor, MINOR);
    return gss_refuse_saying(s, major == 2 ? "R-1.1-4" : "R-1.1-3", message);
}

/* Read the header at s->at. *whole is 0 where the packet is unfinished. */
static int read_header(gss_stream *s, packet *p, int *whole)
{
    *whole = 0;
    s->begin = s->at;
    if (s->size - s->at < HEADER)
        return 1;
    const uint8_t *h = s->bytes + s->at;
    uint32_t check = gss_crc(gss_crc(0, h, 2), h + 4, 12), length = u32_at(h + 8);
    NEED(s, (check & 0xFFFF) == u16_at(h + 2), "R-1.2-1");
    p->type = h[0];
    p->sections = h[1];
    p->frame = u32_at(h + 4);
    NEED(s, p->type >= KEY_PACKET && p->type <= INDEX_PACKET, "R-1.2-2");
    NEED(s, p->sections <= MOST_SECTIONS && length <= 1u << 30 && length >= 5u * p->sections, "R-1.2-3");
    if (s->size - s->at - HEADER < length)
        return 1;
    *whole = 1;
    p->length = length + HEADER;
    p->body = h + HEADER;
    NEED(s, gss_crc(gss_crc(gss_crc(0, h, 2), h + 4, 8), p->body, length) == u32_at(h + 12), "R-1.2-4");
    return 1;
}

static int read_sections(gss_stream *s, packet *p)
{
    uint32_t at = 0, size = p->length - HEADER;
    for (unsigned i = 0; i < p->sections; i++) {
        NEED(s, size - at >= 5, "R-1.3-1");
        unsigned number = p->body[at];
        uint32_t length = u32_at(p->body + at + 1);
        at += 5;
        NEED(s, length <= size - at, "R-1.3-1");
        if (!known(number))
            return gss_refuse_saying(s, "R-1.3-4", "a section of an unknown number: a newer reader is needed");
        for (unsigned j = 0; j < i; j++)
            NEED(s, p->number[j] != number, "R-1.3-3");
        p->number[i] = (uint8_t)number;
        p->payload[i].at = p->body + at;
        p->payload[i].size = length;
        at += length;
    }
    NEED(s, at == size, "R-1.3-2");
    return 1;
}

/* The packets before the index were read and are sound, so their headers lead from one key packet to the next. */
static int check_index(gss_stream *s, const packet *p)
{
    NEED(s, p->sections == 1 && p->number[0] == INDEX, "R-1.5-2");
    const uint8_t *entry = p->payload[0].at, *last = entry + p->payload[0].size;
    NEED(s, p->payload[0].size >= 12 && p->payload[0].size % 12 == 0, "R-1.5-2");
    last -= 12;
    NEED(s, u64_at(last) == s->at && !memcmp(last + 8, "GSSX", 4), "R-1.5-3");
    for (uint64_t at = HEADER; at < s->at;) {
        const uint8_t *h = s->bytes + at;
        if (h[0] == KEY_PACKET) {
            NEED(s, entry < last && u32_at(entry) == u32_at(h + 4) && u64_at(entry + 4) == at, "R-1.5-4");
            entry += 12;
        }
        at += HEADER + (uint64_t)u32_at(h + 8);
    }
    NEED(s, entry == last, "R-1.5-4");
    return 1;
}

static void forget_displacements(gss_frame *scene)
{
    scene->displaced = NULL;
    scene->translations = NULL;
    scene->rotations = NULL;
}

static int apply(gss_stream *s, const packet *p)
{
    state *last = &s->state[s->now], *next = &s->state[!s->now];
    if (p->type == EMPTY_PACKET) {
        NEED(s, p->sections == 0, "R-1.3-5");
        forget_displacements(&last->scene);
    } else if (p->type == KEY_PACKET) {
        int meta = !s->meta_now;
        gss_empty(s, &s->states[!s->now]);
        gss_empty(s, &s->metas[meta]);
        memset(next, 0, sizeof *next);
        memset(&s->meta[meta], 0, sizeof s->meta[meta]);
        TRY(gss_key_packet(s, p, next, &s->meta[meta]));
        memcpy(next->scene.background, s->meta[meta].background, sizeof next->scene.background);
        s->meta_now = meta;
        s->now = !s->now;
    } else {
        gss_empty(s, &s->states[!s->now]);
        TRY(gss_delta_packet(s, p, last, next));
        s->now = !s->now;
    }
    s->state[s->now].scene.frame = p->frame;
    s->started = 1;
    return 1;
}

/* Sets *frame where a frame came; without one and without a fault the stream ends. */
static int next_packet(gss_stream *s, int *frame)
{
    *frame = 0;
    if (!s->at) {
        TRY(check_file(s));
        s->at = HEADER;
    }
    for (;;) {
        packet p;
        int whole;
        TRY(read_header(s, &p, &whole));
        if (!whole) {
            NEED(s, s->started, "R-1.4-4");
            return 1;
        }
        NEED(s, !s->indexed, "R-1.4-3");
        TRY(read_sections(s, &p));
        NEED(s, s->started || p.type == KEY_PACKET, "R-1.4-1");
        uint64_t before = s->state[s->now].scene.frame;
        if (p.type != INDEX_PACKET) {
            NEED(s, !s->started || p.frame == before + 1, "R-1.4-2");
            TRY(apply(s, &p));
            *frame = 1;
        } else {
            NEED(s, p.frame == before, "R-1.5-1");
            TRY(check_index(s, &p));
            s->indexed = 1;
        }
        s->at += p.length;
        if (*frame)
            return 1;
    }
}

gss_stream *gss_open(const void *bytes, size_t size, size_t limit)
{
    gss_stream *s = calloc(1, sizeof *s);
    if (!s)
        return NULL;
    s->bytes = bytes;
    s->size = size;
    s->limit = limit;
    s->result = GSS_FRAME;
    return s;
}

int gss_next(gss_stream *s)
{
    if (s->result != GSS_FRAME)
        return s->result;
    int frame, sound = next_packet(s, &frame);
    gss_empty(s, &s->scratch);
    s->result = !sound ? s->fault.code : frame ? GSS_FRAME : GSS_END;
    return s->result;
}

const gss_frame *gss_state(const gss_stream *s) { return s->started ? &s->state[s->now].scene : NULL; }

const gss_meta_info *gss_meta(const gss_stream *s) { return s->started ? &s->meta[s->meta_now] : NULL; }

const gss_fault *gss_error(const gss_stream *s) { return &s->fault; }

void gss_close(gss_stream *s)
{
    if (!s)
        return;
    region *all[5] = {&s->states[0], &s->states[1], &s->metas[0], &s->metas[1], &s->scratch};
    for (unsigned i = 0; i < 5; i++) {
        gss_empty(s, all[i]);
        free(all[i]->first);
    }
    free(s);
}
