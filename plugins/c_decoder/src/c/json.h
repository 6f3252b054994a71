/* A JSON text as a tree, without recursion: what meta.c takes from json.c. */
#ifndef GSS_JSON_H
#define GSS_JSON_H

#include "decoder.h"

enum { JSON_NULL, JSON_TRUE, JSON_FALSE, JSON_NUMBER, JSON_TEXT, JSON_ARRAY, JSON_OBJECT };

typedef struct json json;
struct json {
    int type;
    uint32_t length;      /* bytes of a text, or number of elements or entries */
    double number;        /* of a number */
    const char *text;     /* of a text: without escapes, and with a zero byte behind it */
    const char *key;      /* of an entry of an object, likewise */
    uint32_t key_length;
    json *first, *last;   /* elements or entries */
    json *next;           /* behind this one in the same array or object */
};

/* The root, an object. Everything is kept in the region; the text ends with a zero byte. */
int gss_parse(gss_stream *s, const uint8_t *text, uint32_t length, region *keep, json **root);

/* The last entry of that name, NULL without one or where from is NULL or no object. */
const json *gss_entry(const json *from, const char *name);

#endif
