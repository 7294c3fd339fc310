/* Prints how many bytes of stack, in hexadecimal, all recorded periods have touched below main. */
#include "quadsim_data.h"
#include "target.h"
#include "vectors.h"

#define PAINTED 65536
#define PAINT 0xA5U

static quadsim_law law;
static quadsim_memory memory;

int main(void)
{
    char line[9];
    int k, digit;
    uint32_t untouched = 0;
    unsigned char *top = __builtin_frame_address(0);
    volatile unsigned char *bottom = top - PAINTED, *byte;
    for (byte = bottom; byte < top - 256; byte++) { /* not main's own frame */
        *byte = PAINT;
    }
    quadsim_law_start(&law, &memory);
    quadsim_law_reset(&law, quadsim_vectors_before);
    for (k = 0; k < quadsim_vectors_count; k++) {
        quadsim_real command[4];
        const struct quadsim_vector *recorded = &quadsim_vectors[k];
        (void)quadsim_law_step(&law, QUADSIM_PHASE_FLYING, recorded->state, quadsim_vectors_path[k], recorded->acting,
                               command);
    }
    while (bottom[untouched] == PAINT) {
        untouched++;
    }
    for (digit = 0; digit < 8; digit++) {
        line[digit] = "0123456789abcdef"[((PAINTED - untouched) >> (28 - 4 * digit)) & 15U];
    }
    line[8] = '\0';
    target_print(line);
    return 0;
}
