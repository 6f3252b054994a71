/* Whole Gaussians, as key packets and joining rows have them: sections 3.6 and 3.7. */
#include "decoder.h"

enum { MOST_CODE = 1 << 20 };

uint32_t gss_width(const gss_frame *scene, unsigned attribute)
{
    static const uint8_t widths[ATTRIBUTES - 1] = {3, 4, 3, 1, 3};
    return attribute < ATTRIBUTES - 1 ? widths[attribute] : 3 * scene->harmonics;
}

float *gss_column(const gss_frame *scene, unsigned attribute)
{
    float *const columns[ATTRIBUTES] = {scene->means, scene->quats, scene->scales,
                                        scene->opacities, scene->sh0, scene->shN};
    return columns[attribute];
}

int gss_allocate_scene(gss_stream *s, region *from, gss_frame *scene)
{
    float **const columns[ATTRIBUTES] = {&scene->means, &scene->quats, &scene->scales,
                                         &scene->opacities, &scene->sh0, &scene->shN};
    for (unsigned i = 0; i < ATTRIBUTES; i++)
        TRY(*columns[i] = gss_take(s, from, (uint64_t)scene->rows * gss_width(scene, i), sizeof(float)));
    return 1;
}

static int in_range(int32_t code) { return code > -MOST_CODE && code < MOST_CODE; }

/* The head of an attribute: its fractional bits, and its symbols of so many channels. */
static int open_attribute(gss_stream *s, span from, uint32_t rows, uint32_t channels, int *b, int32_t **symbols)
{
    NEED(s, from.size >= 2, "R-1.3-6");
    *b = i8_at(from.at);
    NEED(s, *b >= 1 && *b <= 20, "R-3.6-1");
    return gss_symbols(s, rest_of(from, 2), rows, channels, symbols);
}

static int channels_are(span from, uint32_t channels) { return from.size < 2 || from.at[1] == channels; }

static int read_plain(gss_stream *s, span from, uint32_t rows, uint32_t width, float *out, int32_t **codes, int *b)
{
    NEED(s, channels_are(from, width), "R-3.6-2");
    TRY(open_attribute(s, from, rows, width, b, codes));
    for (uint32_t c = 0; c < width; c++)
        for (uint32_t i = 0; i < rows; i++) {
            int32_t code = (*codes)[(size_t)c * rows + i];
            NEED(s, in_range(code), "R-3.6-3");
            out[(size_t)i * width + c] = (float)ldexp(code, -*b);
        }
    return 1;
}

static int read_colours(gss_stream *s, span from, uint32_t rows, uint32_t triples, float *out)
{
    int b;
    int32_t *codes;
    NEED(s, channels_are(from, 3 * triples), "R-3.6-2");
    TRY(open_attribute(s, from, rows, 3 * triples, &b, &codes));
    for (size_t i = 0; i < (size_t)rows * 3 * triples; i++)
        NEED(s, in_range(codes[i]), "R-3.6-3");
    double luma = ldexp(1, -b), chroma = ldexp(1, 1 - b);
    for (uint32_t t = 0; t < triples; t++) {
        const int32_t *y = codes + (size_t)3 * t * rows, *o = y + rows, *g = o + rows;
        for (uint32_t i = 0; i < rows; i++) {
            float *rgb = out + ((size_t)i * triples + t) * 3;
            double Co = o[i] * chroma, Cg = g[i] * chroma;
            double u = y[i] * luma - Cg / 2, blue = u - Co / 2;
            rgb[0] = (float)(blue + Co);
            rgb[1] = (float)(Cg + u);
            rgb[2] = (float)blue;
        }
    }
    return 1;
}

static int read_quats(gss_stream *s, span from, uint32_t rows, float *out)
{
    int b;
    int32_t *symbols;
    NEED(s, channels_are(from, 4), "R-3.6-2");
    TRY(open_attribute(s, from, rows, 5, &b, &symbols));
    int64_t one = (int64_t)1 << (2 * b);
    for (uint32_t i = 0; i < rows; i++, out += 4) {
        const int32_t *at = symbols + i;
        int32_t j = at[0], r = at[(size_t)4 * rows];
        int64_t code[4] = {0}, left = one, most = 0;
        NEED(s, j >= 0 && j <= 3, "R-3.6-4");
        for (int c = 0, other = 1; c < 4; c++) {
            if (c == j)
                continue;
            int32_t value = at[(size_t)other++ * rows];
            NEED(s, in_range(value), "R-3.6-3");
            code[c] = value;
            left -= code[c] * code[c];
            int64_t size = value < 0 ? -(int64_t)value : value;
            most = size > most ? size : most;
        }
        code[j] = r + (int64_t)rint(sqrt(left > 0 ? (double)left : 0.0));
        NEED(s, code[j] > 0 && code[j] >= most, "R-3.6-5");
        NEED(s, code[j] < MOST_CODE, "R-3.6-3");
        for (int c = 0; c < 4; c++)
            out[c] = (float)ldexp((double)code[c], -b);
    }
    return 1;
}

static int64_t floor_shift(int64_t value, int shift)
{
    int64_t unit = (int64_t)1 << shift, quotient = value / unit;
    return quotient - (value % unit < 0);
}

/* Depths first, so that the size of the bits is known; then the values. */
static int read_means(gss_stream *s, span from, uint32_t rows, const int32_t *scales, int b, float *out)
{
    if (!rows) {
        NEED(s, from.size == 0, "R-1.3-6");
        return 1;
    }
    NEED(s, from.size >= 3, "R-1.3-6");
    int f = i8_at(from.at), k = i8_at(from.at + 1), c = i8_at(from.at + 2);
    NEED(s, f >= -60 && f <= 60 && c >= -60 && c <= 60 && c - f >= 0 && c - f <= 24, "R-3.7-1");
    span part[2];
    int32_t *steps;
    TRY(gss_parts(s, rest_of(from, 3), 2, part));
    TRY(gss_symbols(s, part[0], rows, 3, &steps));
    uint8_t *depth = gss_take(s, &s->scratch, rows, 1);
    TRY(depth);
    uint64_t total = 0;
    for (uint32_t i = 0; i < rows; i++) {
        int64_t z = scales[i];
        for (int axis = 1; axis < 3; axis++) {
            int64_t other = scales[(size_t)axis * rows + i];
            z = other < z ? other : z;
        }
        int64_t e = floor_shift(z * 1512775, 20 + b) - k, finest = e > f ? e : f;
        depth[i] = c > finest ? (uint8_t)(c - finest) : 0;
        total += 3u * depth[i];
    }
    NEED(s, part[1].size == (total + 7) / 8, "R-3.7-3");
    bits fields = {part[1], 0};
    int64_t cell[3] = {0, 0, 0};
    for (uint32_t i = 0; i < rows; i++)
        for (int axis = 0; axis < 3; axis++) {
            uint64_t within;
            cell[axis] += steps[(size_t)axis * rows + i];
            NEED(s, cell[axis] >= -(1 << 29) && cell[axis] <= 1 << 29, "R-3.7-2");
            TRY(gss_field(s, &fields, depth[i], &within));
            out[(size_t)i * 3 + axis] = (float)ldexp((double)cell[axis] + ldexp((double)within, -depth[i]), c);
        }
    return gss_end_of_bits(s, &fields, "R-3.7-3");
}

/* The sections are in the order of attributes. scene->rows is known; the rest of the scene's arrays comes to be here. */
int gss_gaussians(gss_stream *s, const span sections[ATTRIBUTES], region *from, gss_frame *scene)
{
    int b;
    int32_t *codes, *scales;
    NEED(s, sections[5].size >= 2, "R-1.3-6");
    uint32_t channels = sections[5].at[1];
    NEED(s, channels == 0 || channels == 9 || channels == 24 || channels == 45, "R-3.6-2");
    scene->harmonics = channels / 3;
    TRY(gss_allocate_scene(s, from, scene));
    TRY(read_quats(s, sections[1], scene->rows, scene->quats));
    TRY(read_plain(s, sections[3], scene->rows, 1, scene->opacities, &codes, &b));
    TRY(read_colours(s, sections[4], scene->rows, 1, scene->sh0));
    TRY(read_colours(s, sections[5], scene->rows, scene->harmonics, scene->shN));
    TRY(read_plain(s, sections[2], scene->rows, 3, scene->scales, &scales, &b));
    return read_means(s, sections[0], scene->rows, scales, b, scene->means);
}
