/* Answers the recorded periods.  A period is wrong where its status is not the recorded one, or a command is farther
 * from the exact optimum than it may be; then the exit status is 1.  Prints a line of each wrong period, in hexadecimal
 * digits: its number, its status, the changes of the active set, the bits of the four commands, and the ticks that it
 * took. */
#include "quadsim_data.h"
#include "target.h"
#include "vectors.h"

#ifndef PRINT_PERIODS
#define PRINT_PERIODS 0 /* 1 prints the line of every period */
#endif

static quadsim_law law;
static quadsim_memory memory;

/* Write a value's bytes, the most significant first, and a blank; returns what follows. */
static char *put(char *line, const void *value, size_t bytes)
{
    const unsigned char *byte = (const unsigned char *)value + bytes; /* all targets are little-endian */
    for (; bytes > 0; bytes--) {
        byte--;
        *line++ = "0123456789abcdef"[*byte >> 4];
        *line++ = "0123456789abcdef"[*byte & 15U];
    }
    *line++ = ' ';
    return line;
}

int main(void)
{
    int k, j, failed = 0;
    if (!quadsim_law_fits()) {
        target_print("wrong: the controller needs another amount of memory\n");
        return 1;
    }
    quadsim_law_start(&law, &memory);
    quadsim_law_reset(&law, quadsim_vectors_before);
    for (k = 0; k < quadsim_vectors_count; k++) {
        const struct quadsim_vector *recorded = &quadsim_vectors[k];
        const uint32_t started = target_ticks();
        char line[128], *end = line;
        quadsim_real command[4];
        const int status =
            (int)quadsim_law_step(&law, QUADSIM_PHASE_FLYING, recorded->state, quadsim_vectors_path[k],
                                  recorded->acting, command);
        const int changes = quadsim_law_changes(&law);
        const uint32_t ticks = target_ticks() - started;
        /* Else there is no optimum to compare with. */
        const int optimal = quadsim_is_flown((enum quadsim_status)recorded->status);
        const int flown = quadsim_is_flown((enum quadsim_status)status);
        /* In float rounding alone may make a bound active: any status of an optimum will do. */
        const int same = QUADSIM_VECTORS_ANY_OPTIMUM || status == recorded->status;
        int wrong = optimal ? !same || !flown : flown;
        end = put(end, &k, sizeof k);
        end = put(end, &status, sizeof status);
        end = put(end, &changes, sizeof changes);
        for (j = 0; j < 4; j++) {
            const quadsim_real off = command[j] - recorded->command[j];
            end = put(end, &command[j], sizeof command[j]);
            wrong |= optimal && !(off <= QUADSIM_VECTORS_TOLERANCE && off >= -QUADSIM_VECTORS_TOLERANCE);
        }
        end = put(end, &ticks, sizeof ticks);
        end[-1] = '\n';
        *end = '\0';
        if (wrong) {
            target_print("wrong: ");
        }
        if (PRINT_PERIODS > 0 || wrong) {
            target_print(line);
        }
        failed |= wrong;
    }
    if (failed) {
        target_print("wrong: a status or a command is not the recorded one; each line above is a period: its number, "
                     "status, changes of the active set, four commands and ticks, in hexadecimal digits\n");
    } else {
        target_print("every recorded period agrees\n");
    }
    return failed;
}
