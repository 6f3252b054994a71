/* Print the index and the hash of every frame of a stream: the conformance program of this decoder. Of several streams
   the path comes first, and the exit code is the highest. */
#include "gss.h"

#include <stdio.h>
#include <stdlib.h>

static void *read_file(const char *path, size_t *size)
{
    FILE *file = fopen(path, "rb");
    if (!file)
        return NULL;
    size_t room = 1 << 16;
    char *bytes = malloc(room);
    *size = 0;
    while (bytes) {
        *size += fread(bytes + *size, 1, room - *size, file);
        if (*size < room)
            break;
        char *more = room <= SIZE_MAX / 2 ? realloc(bytes, room *= 2) : NULL;
        if (!more)
            free(bytes);
        bytes = more;
    }
    if (bytes && *size) { /* an exact size: a tool that watches memory then sees what is read behind the file */
        char *exact = realloc(bytes, *size);
        bytes = exact ? exact : bytes;
    }
    fclose(file);
    return bytes;
}

static int dump(const char *path)
{
    size_t size;
    void *bytes = read_file(path, &size);
    if (!bytes) {
        fprintf(stderr, "cannot read %s\n", path);
        return 2;
    }
    gss_stream *stream = gss_open(bytes, size, 0);
    int found = GSS_NO_MEMORY;
    while (stream && (found = gss_next(stream)) == GSS_FRAME) {
        char digits[65];
        gss_hash(gss_state(stream), digits);
        printf("%lu %s\n", (unsigned long)gss_state(stream)->frame, digits);
    }
    if (found == GSS_REFUSED)
        printf("refused %s\n", gss_error(stream)->message);
    if (found == GSS_NO_MEMORY)
        fprintf(stderr, "%s\n", stream ? gss_error(stream)->message : "there is no memory");
    gss_close(stream);
    free(bytes);
    return found == GSS_END ? 0 : found == GSS_REFUSED ? 1 : 2;
}

int main(int count, char **words)
{
    int worst = 0;
    if (count < 2) {
        fprintf(stderr, "usage: gss_dump STREAM [STREAM ...]\n");
        return 2;
    }
    for (int i = 1; i < count; i++) {
        if (count > 2)
            printf("file %s\n", words[i]);
        int code = dump(words[i]);
        worst = code > worst ? code : worst;
    }
    return worst;
}
