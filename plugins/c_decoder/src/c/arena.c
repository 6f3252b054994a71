/* The memory of a stream, and its fault. */
#include "decoder.h"

#include <stdio.h>
#include <stdlib.h>

enum { ALIGN = 16, SMALLEST = 1 << 16 };

struct block {
    block *next;
    size_t size, used;
};

static size_t head_size(void) { return (sizeof(block) + ALIGN - 1) / ALIGN * ALIGN; }

static void *no_memory(gss_stream *s)
{
    s->fault.code = GSS_NO_MEMORY;
    s->fault.byte = s->begin;
    s->fault.rule[0] = 0;
    snprintf(s->fault.message, sizeof s->fault.message,
             "the packet at byte %llu needs more memory than there is, or than the limit allows",
             (unsigned long long)s->begin);
    return NULL;
}

void *gss_take(gss_stream *s, region *from, uint64_t count, size_t size)
{
    if (count > (SIZE_MAX - 4096) / 2 / size)
        return no_memory(s);
    size_t need = ((size_t)count * size + ALIGN) / ALIGN * ALIGN; /* at least one unit, so that no two are alike */
    block *b = from->first;
    if (!b || b->size - b->used < need) {
        size_t least = need > from->want ? need : from->want;
        least = least > SMALLEST ? least : SMALLEST;
        from->want = 0;
        if (s->limit && least + s->held > s->limit)
            least = need;
        if (s->limit && least + s->held > s->limit)
            return no_memory(s);
        b = malloc(head_size() + least);
        if (!b)
            return no_memory(s);
        b->next = from->first;
        b->size = least;
        b->used = 0;
        from->first = b;
        s->held += least;
    }
    void *found = (uint8_t *)b + head_size() + b->used;
    b->used += need;
    return found;
}

void *gss_zeros(gss_stream *s, region *from, uint64_t count, size_t size)
{
    void *found = gss_take(s, from, count, size);
    if (found)
        memset(found, 0, (size_t)count * size);
    return found;
}

void gss_empty(gss_stream *s, region *which)
{
    block *b = which->first;
    if (b && !b->next) {
        b->used = 0;
        return;
    }
    which->want = 0;
    while (b) {
        block *next = b->next;
        which->want += b->used;
        s->held -= b->size;
        free(b);
        b = next;
    }
    which->first = NULL;
}

void gss_copy(void *to, const void *from, uint64_t bytes)
{
    if (bytes)
        memcpy(to, from, (size_t)bytes);
}

int gss_refuse_saying(gss_stream *s, const char *rule, const char *message)
{
    s->fault.code = GSS_REFUSED;
    s->fault.byte = s->begin;
    snprintf(s->fault.rule, sizeof s->fault.rule, "%s", rule);
    snprintf(s->fault.message, sizeof s->fault.message, "%s at byte %llu: %s", rule, (unsigned long long)s->begin,
             message);
    return 0;
}

int gss_refuse(gss_stream *s, const char *rule)
{
    return gss_refuse_saying(s, rule, "the packet that begins there breaks this rule of the stream format");
}
