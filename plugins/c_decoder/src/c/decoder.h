/* What the files of the decoder share. Every function that returns int returns 1, or 0 after it has set the fault. */
#ifndef GSS_DECODER_H
#define GSS_DECODER_H

#include "gss.h"

#include <float.h>
#include <math.h>
#include <string.h>

#if defined(FLT_EVAL_METHOD) && FLT_EVAL_METHOD != 0
#error "float and double must be computed in their own precision (R-0.4-1): on 32-bit x86 use -msse2 -mfpmath=sse"
#endif
#if defined(__FAST_MATH__)
#error "-ffast-math changes what is decoded (R-0.4-1)"
#endif
#ifdef __clang__
#pragma STDC FP_CONTRACT OFF
#endif

enum {
    META = 1, LAYOUT = 2, GATES = 3, DECODERS = 4, INDEX = 5, REMOVED = 6, ADDED = 7, MOTION = 8, PATTERN = 9,
    FIELD = 10, LAYERS = 11, REST = 12, LIGHT = 13, MEANS = 16, QUATS = 17, SCALES = 18, OPACITIES = 19, SH0 = 20, SHN = 21
};
enum { KEY_PACKET = 1, DELTA_PACKET = 2, EMPTY_PACKET = 3, INDEX_PACKET = 4 };
enum { ATTRIBUTES = 6, MOST_SECTIONS = 16, MOST_ROWS = 4000000, MOST_UNITS = 64, MOST_META = 1 << 20 };

typedef struct {
    const uint8_t *at;
    uint32_t size;
} span;

/* Memory that is given back all at once. */
typedef struct block block;
typedef struct {
    block *first;
    size_t want; /* what the region held when it was last emptied: the size of its next block */
} region;

typedef struct {
    uint32_t frame;
    uint8_t type;
    uint8_t sections;
    uint32_t length; /* header included */
    const uint8_t *body;
    uint8_t number[MOST_SECTIONS];
    span payload[MOST_SECTIONS];
} packet;

typedef struct {
    uint32_t latents, width; /* 0 latents: no decoder */
    float *weights;          /* [latents, width] */
} matrix;

typedef struct {
    gss_frame scene;
    uint32_t units;
    float unit[MOST_UNITS];
    uint8_t *unit_of_row; /* [N] */
    matrix decoders[ATTRIBUTES];
    int grouped;
    float cell;
    uint32_t brightness_bins, groups;
    uint32_t *group_of_row; /* [N] */
} state;

struct gss_stream {
    const uint8_t *bytes;
    uint64_t size, at, limit, held, begin; /* begin: where the packet at hand begins */
    int result;                            /* what gss_next returned; GSS_FRAME at the beginning */
    int started, indexed;                  /* whether there was a key packet, and the index */
    region states[2], metas[2], scratch;   /* the state and the one to come take turns */
    int now, meta_now;
    state state[2];
    gss_meta_info meta[2];
    gss_fault fault;
};

#define TRY(call) do { if (!(call)) return 0; } while (0)
#define NEED(s, condition, rule) do { if (!(condition)) return gss_refuse((s), (rule)); } while (0)

/* arena.c */
void *gss_take(gss_stream *s, region *from, uint64_t count, size_t size);  /* NULL after the fault is set */
void *gss_zeros(gss_stream *s, region *from, uint64_t count, size_t size);
void gss_empty(gss_stream *s, region *which);
void gss_copy(void *to, const void *from, uint64_t bytes);                 /* also of no bytes */
int gss_refuse(gss_stream *s, const char *rule);
int gss_refuse_saying(gss_stream *s, const char *rule, const char *message);

/* coder.c */
typedef struct {
    span from;
    uint64_t bit;
} bits;

int gss_field(gss_stream *s, bits *b, unsigned width, uint64_t *value);    /* up to 36 bits */
int gss_gamma(gss_stream *s, bits *b, uint64_t *value);
int gss_signed(gss_stream *s, bits *b, int64_t *value);
int gss_end_of_bits(gss_stream *s, const bits *b, const char *rule);
int gss_parts(gss_stream *s, span from, unsigned count, span *parts);
int gss_symbols(gss_stream *s, span from, uint32_t rows, uint32_t channels, int32_t **table); /* [channels, rows] */

typedef struct {
    uint32_t levels, open;
    uint8_t *level; /* one for each entry */
} gates;
int gss_gates(gss_stream *s, span from, uint32_t entries, int one_level, gates *out);

/* container.c */
uint32_t gss_crc(uint32_t before, const uint8_t *bytes, size_t size);      /* begins with 0 */
const span *gss_section(const packet *p, unsigned number);                 /* NULL when the packet has none */
static inline uint32_t u16_at(const uint8_t *p) { return p[0] | (uint32_t)p[1] << 8; }
static inline uint32_t u32_at(const uint8_t *p) { return u16_at(p) | u16_at(p + 2) << 16; }
static inline uint64_t u64_at(const uint8_t *p) { return u32_at(p) | (uint64_t)u32_at(p + 4) << 32; }
static inline float f32_at(const uint8_t *p)
{
    uint32_t bits_of = u32_at(p);
    float value;
    memcpy(&value, &bits_of, 4);
    return value;
}
float gss_half(const uint8_t *p);                                          /* binary16 */
static inline int i8_at(const uint8_t *p) { return *p < 128 ? *p : *p - 256; }
static inline span rest_of(span from, uint32_t skip)
{
    span rest = {from.at + skip, from.size - skip};
    return rest;
}

/* gaussians.c, key.c, meta.c, json.c, zstd.c */
int gss_allocate_scene(gss_stream *s, region *from, gss_frame *scene);     /* of scene->rows and scene->harmonics */
int gss_gaussians(gss_stream *s, const span sections[ATTRIBUTES], region *from, gss_frame *scene);
int gss_key_packet(gss_stream *s, const packet *p, state *next, gss_meta_info *meta);
int gss_read_meta(gss_stream *s, span section, region *keep, gss_meta_info *meta);
int gss_unpack(gss_stream *s, span frame, region *keep, uint8_t **content, uint32_t *length);
uint32_t gss_width(const gss_frame *scene, unsigned attribute);
float *gss_column(const gss_frame *scene, unsigned attribute);

/* delta.c, light.c, motion.c, field.c, residual.c, rows.c: a delta changes next, a copy of last */
int gss_delta_packet(gss_stream *s, const packet *p, const state *last, state *next);
int gss_apply_light(gss_stream *s, span section, state *next);
int gss_motions(gss_stream *s, span section, const state *last, state *next, uint8_t *touched);
void gss_turn(const double by[4], float quat[4]);
void gss_unit_quaternion(const double rotation[3], double quat[4]);
int gss_apply_field(gss_stream *s, span section, state *next, uint8_t *touched);
int gss_residual(gss_stream *s, const packet *p, state *next, uint8_t *touched);
int gss_rows(gss_stream *s, const packet *p, state *next);

#endif
