/* JSON (RFC 8259) of limited depth, and UTF-8. */
#include "json.h"

#include <locale.h>
#include <stdlib.h>

enum { DEEPEST = 100 };
#define NOT_JSON "R-3.2-4"

typedef struct {
    gss_stream *s;
    const uint8_t *at, *end;
    char *texts;      /* room for texts without their escapes and for the digits of numbers */
    json *free_nodes;
} parser;

/* Bytes of the UTF-8 character at p, 0 for none: no surrogate, nothing longer than it must be. */
static unsigned character(const uint8_t *p, const uint8_t *end)
{
    static const uint8_t lowest[5] = {0, 0, 0x80, 0xA0, 0x90}, highest[5] = {0, 0, 0xBF, 0xBF, 0x8F};
    unsigned size = *p < 0x80 ? 1 : *p < 0xC2 ? 0 : *p < 0xE0 ? 2 : *p < 0xF0 ? 3 : *p < 0xF5 ? 4 : 0;
    if (size < 2)
        return size;
    if ((size_t)(end - p) < size)
        return 0;
    uint8_t low = *p == 0xE0 || *p == 0xF0 ? lowest[size] : 0x80;
    uint8_t high = *p == 0xED ? 0x9F : *p == 0xF4 ? highest[4] : 0xBF;
    if (p[1] < low || p[1] > high)
        return 0;
    for (unsigned i = 2; i < size; i++)
        if (p[i] >> 6 != 2)
            return 0;
    return size;
}

static int is_utf8(const uint8_t *p, const uint8_t *end)
{
    while (p < end) {
        unsigned size = character(p, end);
        if (!size)
            return 0;
        p += size;
    }
    return 1;
}

/* Depth and size are tested before anything is built (R-3.2-5). */
static int shallow(const uint8_t *p, const uint8_t *end)
{
    int depth = 0, in_text = 0;
    for (; p < end; p++) {
        if (in_text && *p == '\\')
            p++;
        else if (*p == '"')
            in_text = !in_text;
        else if (!in_text && (*p == '[' || *p == '{'))
            depth++;
        else if (!in_text && (*p == ']' || *p == '}'))
            depth--;
        if (depth > DEEPEST)
            return 0;
    }
    return 1;
}

static void skip_spaces(parser *p)
{
    while (p->at < p->end && (*p->at == ' ' || *p->at == '\t' || *p->at == '\n' || *p->at == '\r'))
        p->at++;
}

static int take_byte(parser *p, uint8_t byte)
{
    if (p->at >= p->end || *p->at != byte)
        return 0;
    p->at++;
    return 1;
}

static int take_word(parser *p, const char *word)
{
    size_t length = strlen(word);
    if ((size_t)(p->end - p->at) < length || memcmp(p->at, word, length))
        return 0;
    p->at += length;
    return 1;
}

static int hexadecimal(parser *p, uint32_t *value)
{
    *value = 0;
    for (int i = 0; i < 4; i++, p->at++) {
        if (p->at >= p->end)
            return 0;
        uint8_t c = *p->at;
        uint32_t digit = c >= '0' && c <= '9' ? c - 48u : (c | 32) >= 'a' && (c | 32) <= 'f' ? (c | 32) - 87u : 16u;
        if (digit > 15)
            return 0;
        *value = *value << 4 | digit;
    }
    return 1;
}

static void put_character(char **to, uint32_t c)
{
    if (c < 0x80) {
        *(*to)++ = (char)c;
        return;
    }
    unsigned more = c < 0x800 ? 1 : c < 0x10000 ? 2 : 3;
    static const uint8_t first[4] = {0, 0xC0, 0xE0, 0xF0};
    *(*to)++ = (char)(first[more] | c >> 6 * more);
    while (more--)
        *(*to)++ = (char)(0x80 | (c >> 6 * more & 0x3F));
}

/* A \u escape, two of them where they are a pair; half of a pair becomes what it would be in UTF-8. */
static int take_escape(parser *p, char **to)
{
    static const char names[] = "\"\\/bfnrt", values[] = "\"\\/\b\f\n\r\t";
    if (p->at >= p->end)
        return 0;
    uint8_t c = *p->at++;
    const char *found = c ? strchr(names, c) : NULL;
    if (found) {
        *(*to)++ = values[found - names];
        return 1;
    }
    uint32_t value, second;
    if (c != 'u' || !hexadecimal(p, &value))
        return 0;
    const uint8_t *behind = p->at;
    if (value >= 0xD800 && value < 0xDC00 && take_word(p, "\\u") && hexadecimal(p, &second) && second >= 0xDC00 &&
        second < 0xE000)
        value = 0x10000 + ((value - 0xD800) << 10) + (second - 0xDC00);
    else
        p->at = behind;
    put_character(to, value);
    return 1;
}

/* A text whose first quotation mark was taken. */
static int take_text(parser *p, const char **text, uint32_t *length)
{
    char *to = p->texts;
    for (;;) {
        if (p->at >= p->end || *p->at < 0x20)
            return 0;
        uint8_t c = *p->at++;
        if (c == '"')
            break;
        if (c != '\\')
            *to++ = (char)c;
        else if (!take_escape(p, &to))
            return 0;
    }
    *text = p->texts;
    *length = (uint32_t)(to - p->texts);
    *to++ = 0;
    p->texts = to;
    return 1;
}

static uint32_t take_digits(parser *p)
{
    const uint8_t *begin = p->at;
    while (p->at < p->end && *p->at >= '0' && *p->at <= '9')
        p->at++;
    return (uint32_t)(p->at - begin);
}

static int take_number(parser *p, double *number)
{
    const uint8_t *begin = p->at;
    take_byte(p, '-');
    if (!take_byte(p, '0') && !take_digits(p))
        return 0;
    if (take_byte(p, '.') && !take_digits(p))
        return 0;
    if (take_byte(p, 'e') || take_byte(p, 'E')) {
        if (!take_byte(p, '+'))
            take_byte(p, '-');
        if (!take_digits(p))
            return 0;
    }
    /* strtod wants the point of the locale, which may be another and longer one. */
    const char *point = localeconv()->decimal_point;
    char *to = p->texts;
    for (const uint8_t *c = begin; c < p->at; c++) {
        if (*c != '.')
            *to++ = (char)*c;
        else
            for (const char *of_point = point; *of_point; of_point++)
                *to++ = *of_point;
    }
    *to = 0;
    *number = strtod(p->texts, NULL);
    return 1;
}

/* One value but what an array or an object contains. */
static int take_value(parser *p, json *node)
{
    uint8_t c = p->at < p->end ? *p->at : 0;
    if (c == '{' || c == '[') {
        node->type = c == '{' ? JSON_OBJECT : JSON_ARRAY;
        p->at++;
        return 1;
    }
    if (c == '"') {
        node->type = JSON_TEXT;
        p->at++;
        return take_text(p, &node->text, &node->length);
    }
    node->type = c == 't' ? JSON_TRUE : c == 'f' ? JSON_FALSE : c == 'n' ? JSON_NULL : JSON_NUMBER;
    if (c == 't' || c == 'f' || c == 'n')
        return take_word(p, c == 't' ? "true" : c == 'f' ? "false" : "null");
    return take_number(p, &node->number);
}

static int take_key(parser *p, json *node)
{
    skip_spaces(p);
    if (!take_byte(p, '"') || !take_text(p, &node->key, &node->key_length))
        return 0;
    skip_spaces(p);
    return take_byte(p, ':');
}

/* The next element or entry of what is open. */
static int take_child(parser *p, json *parent, json *node)
{
    if (parent->type == JSON_OBJECT && !take_key(p, node))
        return 0;
    skip_spaces(p);
    if (!take_value(p, node))
        return 0;
    if (parent->last)
        parent->last->next = node;
    else
        parent->first = node;
    parent->last = node;
    parent->length++;
    return 1;
}

static int take_tree(parser *p, json *root)
{
    json *open[DEEPEST];
    unsigned depth = 1;
    skip_spaces(p);
    if (!take_value(p, root) || root->type != JSON_OBJECT)
        return 0;
    open[0] = root;
    while (depth) {
        json *parent = open[depth - 1];
        skip_spaces(p);
        if (take_byte(p, parent->type == JSON_OBJECT ? '}' : ']')) {
            depth--;
            continue;
        }
        if (parent->last && !take_byte(p, ','))
            return 0;
        json *node = p->free_nodes++;
        if (!take_child(p, parent, node))
            return 0;
        if (node->type == JSON_OBJECT || node->type == JSON_ARRAY) {
            if (depth == DEEPEST)
                return 0;
            open[depth++] = node;
        }
    }
    skip_spaces(p);
    return p->at == p->end;
}

int gss_parse(gss_stream *s, const uint8_t *text, uint32_t length, region *keep, json **root)
{
    const uint8_t *end = text + length;
    NEED(s, is_utf8(text, end), NOT_JSON);
    NEED(s, shallow(text, end), "R-3.2-5");
    /* Every value but the first begins behind a bracket, a colon or a comma outside of texts. */
    uint32_t values = 2;
    for (const uint8_t *p = text; p < end; p++)
        values += *p == ',' || *p == '[' || *p == '{';
    parser p = {s, text, end, NULL, NULL};
    size_t room = (size_t)length + 64 + strlen(localeconv()->decimal_point);
    TRY(p.texts = gss_take(s, keep, room, 1));
    TRY(p.free_nodes = gss_zeros(s, &s->scratch, values, sizeof(json)));
    *root = p.free_nodes++;
    NEED(s, take_tree(&p, *root), NOT_JSON);
    return 1;
}

const json *gss_entry(const json *from, const char *name)
{
    const json *found = NULL;
    size_t length = strlen(name);
    if (!from || from->type != JSON_OBJECT)
        return NULL;
    for (const json *entry = from->first; entry; entry = entry->next)
        if (entry->key_length == length && !memcmp(entry->key, name, length))
            found = entry;
    return found;
}
