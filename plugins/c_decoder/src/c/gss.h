/* A decoder of gsstream streams, version 2.3, in C99 without dependencies but the C library.
 *
 *     gss_stream *s = gss_open(bytes, size, 0);
 *     int found;
 *     while (s && (found = gss_next(s)) == GSS_FRAME) {
 *         const gss_frame *f = gss_state(s);
 *         ... draw f->rows Gaussians of f->means, f->quats and so on ...
 *     }
 *     if (!s || found < 0) ... gss_error(s)->message ...
 *     gss_close(s);
 *
 * The rules that errors cite, such as R-2.1-1, are those of docs/spec. Decoding is exact to the bit, so the compiler
 * must compute as IEEE 754 says (annex F of C99): build with -ffp-contract=off and never with -ffast-math. A stream
 * uses memory of its own alone; several streams may be decoded by several threads, one stream by one thread at a time.
 */
#ifndef GSS_H
#define GSS_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef struct gss_stream gss_stream;

/* What gss_next returns. */
enum {
    GSS_FRAME = 1,     /* the next frame is decoded */
    GSS_END = 0,       /* the stream ends here, or a packet is not wholly there (R-1.6-1) */
    GSS_REFUSED = -1,  /* the stream breaks a rule; the last frame still stands */
    GSS_NO_MEMORY = -2 /* memory, or the limit given to gss_open, does not suffice; the last frame still stands */
};

/* The state after a frame. Values are raw: logarithms of scales, logits of opacities, quaternions of any norm.
 * All arrays belong to the stream, are to be read only, and hold until the next call of gss_next or gss_close. */
typedef struct {
    uint32_t frame;              /* index of the frame */
    uint32_t rows;               /* N Gaussians */
    uint32_t nodes;              /* M nodes: row after row is stored node by node */
    uint32_t harmonics;          /* J: 0, 3, 8 or 15 coefficients of degree 1 to 3 */
    float *means;                /* [N, 3], scene units */
    float *quats;                /* [N, 4], w x y z */
    float *scales;               /* [N, 3], natural logarithms of standard deviations */
    float *opacities;            /* [N], logits */
    float *sh0;                  /* [N, 3], red green blue */
    float *shN;                  /* [N, J, 3] */
    uint32_t *node_counts;       /* [M], rows of each node */
    const uint8_t *displaced;    /* [N], 1 where a row has a displacement (section 4.3), or NULL where no row has one */
    const float *translations;   /* [N, 3], of displaced rows; 0 for others; NULL with displaced */
    const float *rotations;      /* [N, 3], likewise: axis times tangent of half the angle */
    float background[3];         /* what is behind everything, in the light of this frame; red green blue */
} gss_frame;

/* A camera of the last key packet (section 3.3). */
typedef struct {
    const char *id;              /* UTF-8, ends with a zero byte */
    int held_out;                /* 1 for a camera of test, 0 for one of train */
    uint32_t width, height;      /* pixels */
    double near_plane;           /* scene units */
    double viewmat[16];          /* row by row */
    double K[9];                 /* row by row */
} gss_camera;

/* The meta of the last key packet (section 3.2). Arrays hold as long as those of gss_frame. */
typedef struct {
    double fps;
    float background[3];
    double world_rotation[9], world_offset[3], world_scale; /* section 3.4 */
    uint32_t cameras;
    const gss_camera *camera;
    const char *json;            /* the whole text, to read further entries of; it comes from strangers */
    size_t json_length;
} gss_meta_info;

/* What went wrong. */
typedef struct {
    int code;                    /* GSS_REFUSED, GSS_NO_MEMORY, or 0 when nothing did */
    char rule[12];               /* the rule that is broken, "" without one */
    uint64_t byte;               /* where the packet begins in the file */
    char message[160];           /* a sentence for people */
} gss_fault;

/* Open a stream that lies in memory; the bytes must stay there until gss_close, and nothing is read behind them.
 * limit: the most bytes that the stream may allocate, 0 for no limit of its own. NULL when there is no memory at all.
 * A file that is no stream is reported by the first gss_next. */
gss_stream *gss_open(const void *bytes, size_t size, size_t limit);

/* Decode the next frame. What is returned other than GSS_FRAME is returned again by every later call. */
int gss_next(gss_stream *stream);

/* The state after the last frame that gss_next decoded, NULL before the first one. */
const gss_frame *gss_state(const gss_stream *stream);

/* The meta that holds for that frame, NULL before the first one. */
const gss_meta_info *gss_meta(const gss_stream *stream);

/* What the last gss_next reported. */
const gss_fault *gss_error(const gss_stream *stream);

/* The hash of a frame (section 0.5): 64 hexadecimal digits and a zero byte. */
void gss_hash(const gss_frame *frame, char digits[65]);

/* Free everything. NULL is allowed. */
void gss_close(gss_stream *stream);

#ifdef __cplusplus
}
#endif
#endif
