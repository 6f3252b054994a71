/* The light of a frame: section 4.10. */
#include "decoder.h"

float gss_half(const uint8_t *p)
{
    uint32_t bits_of = u16_at(p), exponent = bits_of >> 10 & 31, fraction = bits_of & 1023;
    double size = exponent ? ldexp(1024.0 + fraction, (int)exponent - 25) : ldexp(fraction, -24);
    return (float)(bits_of >> 15 ? -size : size);
}

/* Colour number i is of channel i % 3. */
static int light(gss_stream *s, float *colours, uint64_t count, const float factor[3], const float offset[3])
{
    for (uint64_t i = 0; i < count; i++) {
        float product = colours[i] * factor[i % 3];
        colours[i] = product + offset[i % 3];
        NEED(s, isfinite(colours[i]), "R-4.10-2");
    }
    return 1;
}

int gss_apply_light(gss_stream *s, span section, state *next)
{
    gss_frame *scene = &next->scene;
    float factor[3], offset[3];
    NEED(s, section.size == 6, "R-1.3-6");
    for (int c = 0; c < 3; c++) {
        factor[c] = gss_half(section.at + 2 * c);
        NEED(s, factor[c] >= 0.00390625f && factor[c] <= 256.0f, "R-4.10-1");
        offset[c] = (float)(((double)factor[c] - 1) * 1.7724538509055159);
        scene->background[c] *= factor[c];
        NEED(s, isfinite(scene->background[c]), "R-4.10-2");
    }
    TRY(light(s, scene->sh0, (uint64_t)3 * scene->rows, factor, offset));
    for (uint64_t i = 0; i < (uint64_t)3 * scene->rows * scene->harmonics; i++) {
        scene->shN[i] *= factor[i % 3];
        NEED(s, isfinite(scene->shN[i]), "R-4.10-2");
    }
    return 1;
}
