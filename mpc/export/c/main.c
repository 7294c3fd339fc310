/* Runs the recorded periods.  Prints of each its status and its command's bits, and last what differs:
 * exit status 0 if every status is as recorded and every command as near to the exact optimum as it should be. */
#include <inttypes.h>
#include <stdio.h>
#include <string.h>

#include "vectors.h"

static quadsim_mpc mpc;

static void print_bits(quadsim_real number)
{
#ifdef QUADSIM_FLOAT
    uint32_t bits;
    memcpy(&bits, &number, sizeof(bits));
    printf(" %08" PRIx32, bits);
#else
    uint64_t bits;
    memcpy(&bits, &number, sizeof(bits));
    printf(" %016" PRIx64, bits);
#endif
}

int main(void)
{
    int k, j, others = 0, far = 0;
    quadsim_real most = 0;
    quadsim_mpc_reset(&mpc, quadsim_vectors_speeds);
    for (k = 0; k < quadsim_vectors_count; k++) {
        const struct quadsim_vector *asked = &quadsim_vectors[k];
        quadsim_real command[4];
        const int status = (int)quadsim_mpc_step(&mpc, asked->state, quadsim_vectors_path[k], asked->acting, command);
        /* From QUADSIM_CLIPPED on there is no optimum to compare with. */
        const int optimal = asked->status < (int)QUADSIM_CLIPPED;
        printf("%d", status);
        for (j = 0; j < 4; j++) {
            const quadsim_real off =
                command[j] > asked->command[j] ? command[j] - asked->command[j] : asked->command[j] - command[j];
            print_bits(command[j]);
            if (optimal && off > most) {
                most = off;
            }
            far += optimal && !(off <= QUADSIM_VECTORS_TOLERANCE);
        }
        printf("\n");
        others += optimal ? status != asked->status : status < (int)QUADSIM_CLIPPED;
    }
    fprintf(stderr, "%d periods: %d with another status, %d speeds beyond tolerance, at most %.2e rad/s off\n",
            quadsim_vectors_count, others, far, (double)most);
    return others + far > 0;
}
