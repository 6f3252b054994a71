/* Say what a stream is: versions, frames, Gaussians, cameras. */
#include "gss.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static void *read_file(const char *path, size_t *size)
{
    FILE *file = fopen(path, "rb");
    char *bytes = NULL;
    long length = -1;
    if (file && !fseek(file, 0, SEEK_END) && (length = ftell(file)) >= 0 && !fseek(file, 0, SEEK_SET))
        bytes = malloc((size_t)length + 1);
    *size = bytes ? fread(bytes, 1, (size_t)length, file) : 0;
    if (file)
        fclose(file);
    return bytes;
}

int main(int count, char **words)
{
    size_t size;
    void *bytes = count == 2 ? read_file(words[1], &size) : NULL;
    gss_stream *stream = bytes ? gss_open(bytes, size, 0) : NULL;
    if (!stream) {
        fprintf(stderr, count == 2 ? "cannot read %s\n" : "usage: gss_info STREAM\n", words[count - 1]);
        free(bytes);
        return 2;
    }
    unsigned long frames = 0;
    float background[3] = {0};
    int found;
    while ((found = gss_next(stream)) == GSS_FRAME) {
        const gss_frame *frame = gss_state(stream);
        if (!frames++) {
            const gss_meta_info *meta = gss_meta(stream);
            printf("%.6g frames a second, %lu cameras, background %.3g %.3g %.3g\n", meta->fps,
                   (unsigned long)meta->cameras, meta->background[0], meta->background[1], meta->background[2]);
            memcpy(background, meta->background, sizeof background);
        }
        printf("frame %lu: %lu Gaussians in %lu nodes, %lu harmonics%s", (unsigned long)frame->frame,
               (unsigned long)frame->rows, (unsigned long)frame->nodes, (unsigned long)frame->harmonics,
               frame->displaced ? ", some moved" : "");
        if (memcmp(background, frame->background, sizeof background))
            printf(", background %.9g %.9g %.9g", frame->background[0], frame->background[1], frame->background[2]);
        printf("\n");
        memcpy(background, frame->background, sizeof background);
    }
    printf("%lu frames%s%s\n", frames, found < 0 ? ", then: " : "", found < 0 ? gss_error(stream)->message : "");
    gss_close(stream);
    free(bytes);
    return found < 0;
}
