/* Steps of a controller from arbitrary bytes, for libFuzzer: for any input, command and plan are finite and within
 * every bound, the status and the fallback level belong together, and the active set changes no more often than it may.
 */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#include <string.h>

#include "quadsim_data.h"
#include "quadsim_math.h"

#define STEPS 8 /* of an input at most, after a reset */
#ifndef MOST_CHANGES
#define MOST_CHANGES (4 * QUADSIM_CONTROLLER.problem->changes) /* of a law that solves one */
#endif

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static unsigned long steps;
static int registered; /* whether it will be printed */

static void report(void)
{
    (void)printf("steps: %lu\n", steps);
    (void)fflush(stdout);
}

static void require(int holds, const char *what)
{
    if (!holds) {
        (void)fprintf(stderr, "violated: %s\n", what);
        abort();
    }
}

/* The next number: near what flies, or far from it, or any bits. */
static real take(const uint8_t **data, size_t *left, int manner, real centre, real scale)
{
    int16_t share = 0;
    real number = R(0.0);
    const size_t bytes = manner == 3 ? sizeof number : sizeof share;
    if (*left < bytes) {
        return centre;
    }
    if (manner == 3) {
        memcpy(&number, *data, bytes);
    } else {
        memcpy(&share, *data, bytes);
        number = centre + scale * (manner == 2 ? R(100.0) : R(1.0)) * (real)share / R(32768.0);
    }
    *data += bytes;
    *left -= bytes;
    return number;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static const real scale[19] = {R(1.0), R(2.0), R(1.0), R(2.0), R(1.0), R(2.0), R(0.1), R(1.0), R(0.1), R(1.0),
                                   R(0.5), R(1.0), R(1.0), R(0.5), R(0.5), R(0.5), R(1.0), R(1.0), R(1.0)};
    const quadsim_fallback *fallback = QUADSIM_CONTROLLER.fallback;
    quadsim_law *law = malloc(sizeof *law); /* on the heap, where the sanitizer sees both of its ends */
    quadsim_memory *memory = malloc(sizeof *memory);
    real *reference = malloc(sizeof(real) * QUADSIM_ROWS * QUADSIM_ROW);
    real *plan = malloc(sizeof(real) * QUADSIM_HORIZON * 4);
    real command[4];
    int i, j;
    if (!registered) {
        registered = !atexit(report);
    }
    memcpy(command, fallback->hover, sizeof command);
    quadsim_law_start(law, memory);
    for (i = 0; i < QUADSIM_ROWS * QUADSIM_ROW; i++) {
        reference[i] = R(0.0);
    }
    for (i = 0; i < STEPS && size > 0; i++) {
        const int manners = *data++;
        real state[QUADSIM_STATE], acting[4], before[4];
        const int place = (manners >> 3) & 7; /* on the ground in a quarter of all steps */
        const enum quadsim_phase phase =
            place == 7 ? QUADSIM_PHASE_LANDED : (place == 6 ? QUADSIM_PHASE_ARMED : QUADSIM_PHASE_FLYING);
        enum quadsim_status status = QUADSIM_MISSED;
        size--;
        for (j = 0; j < QUADSIM_STATE; j++) {
            state[j] = take(&data, &size, manners & 3, R(0.0), scale[j]);
        }
        memmove(reference, reference + QUADSIM_ROW, sizeof(real) * (QUADSIM_ROWS - 1) * QUADSIM_ROW);
        for (j = 0; j < QUADSIM_ROW; j++) {
            reference[(QUADSIM_ROWS - 1) * QUADSIM_ROW + j] = take(&data, &size, (manners >> 2) & 3, R(0.0), R(3.0));
        }
        for (j = 0; j < 4; j++) {
            acting[j] = command[j];
            if ((manners & 64) == 0) {
                acting[j] =
                    take(&data, &size, (manners >> 4) & 3, fallback->hover[j], fallback->targets ? R(5.0) : R(80.0));
            }
        }
        if ((manners & 128) != 0) {
            quadsim_law_reset(law, acting);
            memcpy(command, fallback->hover, sizeof command); /* in force where acting is none */
        }
        memcpy(before, is_within(acting, fallback->largest_command, 4) ? acting : command, sizeof before);
        status = quadsim_law_step(law, phase, state, reference, acting, command);
        steps++;
        require(status >= QUADSIM_FREE && status <= QUADSIM_COMMANDED && status != QUADSIM_MISSED, "a status");
        require((status == QUADSIM_LANDED) == (phase == QUADSIM_PHASE_LANDED), "rotors that stop on the ground alone");
        require((quadsim_is_flown(status) || status == QUADSIM_LANDED) == (law->guard.level == 0),
                "a level without optimum");
        require(law->guard.level >= 0 && law->guard.level <= 3, "a level");
        require(is_finite(law->guard.state, 12), "a state");
        require(is_finite(command, 4), "a finite command");
        require(quadsim_law_changes(law) >= 0, "a number of changes");
        require(quadsim_law_changes(law) <= MOST_CHANGES, "a limited number of changes");
        for (j = 0; j < 4; j++) {
            require(command[j] >= fallback->least[j] && command[j] <= fallback->most[j], "bounds on speeds");
            if (before[j] >= fallback->least[j] && before[j] <= fallback->most[j]) {
                const real step = command[j] - before[j];
                require(step >= fallback->step_least[j] - R(1e-4) && step <= fallback->step_most[j] + R(1e-4),
                        "bounds on steps of speeds");
            }
        }
        quadsim_guard_plan(&law->guard, plan);
        require(is_finite(plan, QUADSIM_HORIZON * 4), "a finite plan");
        for (j = 0; j < QUADSIM_HORIZON * 4; j++) {
            const int input = j % 4;
            const real last = j < 4 ? command[input] : plan[j - 4]; /* the plan begins with the command */
            const real step = plan[j] - last, rounding = R(0.1);
            require(j >= 4 || is_equal(step, R(0.0)), "a plan of the command");
            require(plan[j] >= fallback->least[input] && plan[j] <= fallback->most[input], "bounds on planned speeds");
            require(step >= fallback->step_least[input] - rounding && step <= fallback->step_most[input] + rounding,
                    "bounds on planned steps of speeds");
        }
    }
    free(plan);
    free(reference);
    free(memory);
    free(law);
    return 0;
}
