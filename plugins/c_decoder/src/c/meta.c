/* The meta of a key packet: sections 3.2 to 3.4. */
#include "json.h"

#include <stdlib.h>

static int number_of(const json *node, double *value)
{
    if (!node || node->type != JSON_NUMBER)
        return 0;
    *value = node->number;
    return 1;
}

/* An array of so many numbers. */
static int numbers_of(const json *node, uint32_t count, double *values)
{
    if (!node || node->type != JSON_ARRAY || node->length != count)
        return 0;
    for (const json *element = node->first; element; element = element->next)
        if (!number_of(element, values++))
            return 0;
    return 1;
}

static int finite_floats(const double *values, uint32_t count)
{
    for (uint32_t i = 0; i < count; i++)
        if (!isfinite((float)values[i]))
            return 0;
    return 1;
}

static double determinant(const double m[9])
{
    return m[0] * (m[4] * m[8] - m[5] * m[7]) - m[1] * (m[3] * m[8] - m[5] * m[6]) +
           m[2] * (m[3] * m[7] - m[4] * m[6]);
}

/* Whether R R^T is the identity to that much. */
static int orthogonal(const double r[9], double much)
{
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            double product = r[3 * i] * r[3 * j] + r[3 * i + 1] * r[3 * j + 1] + r[3 * i + 2] * r[3 * j + 2];
            if (!(fabs(product - (i == j)) <= much))
                return 0;
        }
    return 1;
}

static int row_is(const double *row, const double *wanted, uint32_t count)
{
    for (uint32_t i = 0; i < count; i++)
        if (!(fabs(row[i] - wanted[i]) <= 1e-6))
            return 0;
    return 1;
}

/* What stands before the first dot, in lower case, is the name of a device. */
static int is_device(const char *id, uint32_t length)
{
    static const char names[4][4] = {"con", "prn", "aux", "nul"};
    char stem[5] = {0};
    uint32_t size = 0;
    for (; size < length && id[size] != '.'; size++)
        if (size < 4)
            stem[size] = (char)(id[size] >= 'A' && id[size] <= 'Z' ? id[size] + 32 : id[size]);
    if (size == 3)
        for (int i = 0; i < 4; i++)
            if (!memcmp(stem, names[i], 3))
                return 1;
    return size == 4 && (!memcmp(stem, "com", 3) || !memcmp(stem, "lpt", 3)) && stem[3] >= '1' && stem[3] <= '9';
}

static int good_id(const json *id)
{
    const uint8_t *c = (const uint8_t *)id->text, *end = c + id->length;
    if (!id->length || id->length > 120 || end[-1] == '.' || end[-1] == ' ')
        return 0;
    for (; c < end; c++) {
        if (*c < 0x20 || *c == 0x7F || *c == '/' || *c == '\\' || *c == ':')
            return 0;
        if (*c == 0xC2 && c[1] < 0xA0) /* U+0080 to U+009F; behind the last byte stands a zero */
            return 0;
        if (*c == 0xE2 && c[1] == 0x80 && (c[2] == 0xA8 || c[2] == 0xA9)) /* U+2028 and U+2029 */
            return 0;
        if (*c == 0xED && c[1] >= 0xA0) /* half of a surrogate pair */
            return 0;
    }
    return !is_device(id->text, id->length);
}

static int compare_ids(const void *one, const void *other)
{
    const json *a = *(const json *const *)one, *b = *(const json *const *)other;
    int found = memcmp(a->text, b->text, a->length < b->length ? a->length : b->length);
    return found ? found : (a->length > b->length) - (a->length < b->length);
}

static int check_ids(gss_stream *s, const json *ids)
{
    const json **sorted = gss_take(s, &s->scratch, ids->length, sizeof *sorted);
    uint32_t i = 0;
    TRY(sorted);
    for (const json *id = ids->first; id; id = id->next) {
        NEED(s, id->type == JSON_TEXT, "R-3.3-1");
        NEED(s, good_id(id), "R-3.3-2");
        sorted[i++] = id;
    }
    qsort(sorted, i, sizeof *sorted, compare_ids);
    while (i-- > 1)
        NEED(s, compare_ids(&sorted[i], &sorted[i - 1]), "R-3.3-1");
    return 1;
}

static int check_matrices(gss_stream *s, const gss_camera *camera)
{
    static const double bottom[4] = {0, 0, 0, 1};
    const double *v = camera->viewmat, *k = camera->K;
    const double r[9] = {v[0], v[1], v[2], v[4], v[5], v[6], v[8], v[9], v[10]};
    NEED(s, finite_floats(v, 16) && orthogonal(r, 1e-3) && determinant(r) >= 0, "R-3.3-5");
    NEED(s, row_is(v + 12, bottom, 4), "R-3.3-5");
    NEED(s, finite_floats(k, 9) && (float)k[0] > 0 && (float)k[4] > 0, "R-3.3-6");
    NEED(s, fabs(determinant(k)) >= 1e-12, "R-3.3-6");
    NEED(s, fabs(k[1]) <= 1e-6 * k[0] && fabs(k[3]) <= 1e-6 * k[4] && row_is(k + 6, bottom + 1, 3), "R-3.3-6");
    return 1;
}

static int whole(double value, double most) { return value >= 1 && value <= most && floor(value) == value; }

/* One object of cameras; out has room for them. */
static int read_cameras(gss_stream *s, const json *from, int held_out, gss_camera *out)
{
    const json *ids = gss_entry(from, "ids"), *viewmats = gss_entry(from, "viewmats"), *Ks = gss_entry(from, "Ks");
    double width, height, near_plane;
    NEED(s, ids && ids->type == JSON_ARRAY && viewmats && viewmats->type == JSON_ARRAY, "R-3.3-1");
    NEED(s, Ks && Ks->type == JSON_ARRAY && ids->length == viewmats->length && ids->length == Ks->length, "R-3.3-1");
    NEED(s, number_of(gss_entry(from, "width"), &width) && number_of(gss_entry(from, "height"), &height), "R-3.3-1");
    NEED(s, number_of(gss_entry(from, "near"), &near_plane), "R-3.3-1");
    TRY(check_ids(s, ids));
    NEED(s, whole(width, 65536) && whole(height, 65536) && width * height <= 134217728.0, "R-3.3-3");
    NEED(s, (float)near_plane > 0 && isfinite((float)near_plane), "R-3.3-4");
    const json *id = ids->first, *viewmat = viewmats->first, *K = Ks->first;
    for (; id; id = id->next, viewmat = viewmat->next, K = K->next, out++) {
        NEED(s, numbers_of(viewmat, 16, out->viewmat) && numbers_of(K, 9, out->K), "R-3.3-1");
        out->id = id->text;
        out->held_out = held_out;
        out->width = (uint32_t)width;
        out->height = (uint32_t)height;
        out->near_plane = near_plane;
        TRY(check_matrices(s, out));
    }
    return 1;
}

static int read_world(gss_stream *s, const json *world, gss_meta_info *meta)
{
    static const double identity[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
    memcpy(meta->world_rotation, identity, sizeof identity);
    meta->world_scale = 1;
    if (!world)
        return 1;
    NEED(s, world->type == JSON_OBJECT && numbers_of(gss_entry(world, "rotation"), 9, meta->world_rotation), "R-3.4-1");
    NEED(s, numbers_of(gss_entry(world, "offset"), 3, meta->world_offset), "R-3.4-1");
    NEED(s, number_of(gss_entry(world, "scale"), &meta->world_scale), "R-3.4-1");
    for (int i = 0; i < 3; i++)
        NEED(s, isfinite(meta->world_offset[i]), "R-3.4-1");
    NEED(s, isfinite(meta->world_scale) && meta->world_scale > 0, "R-3.4-1");
    NEED(s, orthogonal(meta->world_rotation, 1e-6) && determinant(meta->world_rotation) > 0, "R-3.4-1");
    return 1;
}

int gss_read_meta(gss_stream *s, span section, region *keep, gss_meta_info *meta)
{
    uint8_t *text;
    uint32_t length;
    json *root;
    double background[3];
    TRY(gss_unpack(s, section, keep, &text, &length));
    TRY(gss_parse(s, text, length, keep, &root));
    const json *train = gss_entry(root, "train"), *test = gss_entry(root, "test");
    NEED(s, number_of(gss_entry(root, "fps"), &meta->fps), "R-3.2-6");
    NEED(s, numbers_of(gss_entry(root, "background"), 3, background), "R-3.2-6");
    NEED(s, train && train->type == JSON_OBJECT && test && test->type == JSON_OBJECT, "R-3.2-6");
    NEED(s, meta->fps >= 0.01 && meta->fps <= 100000, "R-3.2-7");
    NEED(s, finite_floats(background, 3), "R-3.2-8");
    for (int i = 0; i < 3; i++)
        meta->background[i] = (float)background[i];
    const json *ids[2] = {gss_entry(train, "ids"), gss_entry(test, "ids")};
    uint32_t first = ids[0] && ids[0]->type == JSON_ARRAY ? ids[0]->length : 0;
    uint32_t second = ids[1] && ids[1]->type == JSON_ARRAY ? ids[1]->length : 0;
    NEED(s, first + second > 0, "R-3.3-1");
    gss_camera *camera = gss_zeros(s, keep, first + second, sizeof *camera);
    TRY(camera);
    TRY(read_cameras(s, train, 0, camera));
    TRY(read_cameras(s, test, 1, camera + first));
    TRY(read_world(s, gss_entry(root, "world"), meta));
    meta->cameras = first + second;
    meta->camera = camera;
    meta->json = (const char *)text;
    meta->json_length = length;
    return 1;
}
