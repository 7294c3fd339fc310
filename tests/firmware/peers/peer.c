/* Solves the QP of each recorded period with another solver and prints what main.c of an export prints: the number, the
 * status (0, or 1 without an optimum), the iterations, the command's bits, and the ticks of the solver alone. */
#include "peer.h"
#include "problem.h"
#include "target.h"

static char *append(char *line, const void *value, int bytes)
{
    const unsigned char *byte = (const unsigned char *)value + bytes;
    *line++ = ' ';
    while (bytes-- > 0) {
        byte--;
        *line++ = "0123456789abcdef"[*byte >> 4];
        *line++ = "0123456789abcdef"[*byte & 15U];
    }
    return line;
}

int main(void)
{
    static real vectors[VECTORS], inputs[INPUTS];
    uint32_t k;
    for (k = 0; k < PERIODS; k++) {
        char line[128], *end = line;
        real command[4];
        int i, j, iterations;
        uint32_t ticks, status;
        for (i = 0; i < 12; i++) {
            inputs[i] = STATE[k * 12 + i];
        }
        for (i = 0; i < INPUTS - 17; i++) {
            inputs[12 + i] = PATH[k * 4 + i];
        }
        for (i = 0; i < 4; i++) {
            inputs[INPUTS - 5 + i] = ACTING[k * 4 + i];
        }
        inputs[INPUTS - 1] = R(1.0);
        for (i = 0; i < VECTORS; i++) {
            vectors[i] = R(0.0);
            for (j = 0; j < INPUTS; j++) {
                vectors[i] += MAP[i * INPUTS + j] * inputs[j];
            }
        }
        ticks = target_ticks();
        iterations = peer_solve(vectors, command);
        ticks = target_ticks() - ticks;
        status = iterations < 0;
        end = append(end, &k, sizeof k);
        end = append(end, &status, sizeof status);
        end = append(end, &iterations, sizeof iterations);
        for (i = 0; i < 4; i++) {
            end = append(end, &command[i], sizeof command[i]);
        }
        end = append(end, &ticks, sizeof ticks);
        *end++ = '\n';
        *end = '\0';
        target_print(line);
    }
    return 0;
}
