/* Many vehicles over a control period, and the margins of bounds beside the flight, at the physics rate.
 *
 * Memory is the caller's, and each flight's is its own: threads may fly disjoint ranges of one array at the same time,
 * and results have the same bits for any ranges. */
#ifndef QUADSIM_BATCH_H
#define QUADSIM_BATCH_H

#include "quadsim_plant.h"

#ifdef __cplusplus
extern "C" {
#endif

enum { STATE = 12, TERMS = 16 };

/* The signals of bounds; those from SIGNAL_ERROR on exist only at the start of a control period. */
enum {
    SIGNAL_SUM, /* of states and rotor speeds, with factors */
    SIGNAL_TILT,
    SIGNAL_BODY_RATE,
    SIGNAL_THRUST,   /* of all rotors, where an inner loop has a target */
    SIGNAL_SPEED,    /* of every rotor */
    SIGNAL_ERROR,    /* true state less reference: x, y, z, yaw */
    SIGNAL_ESTIMATE, /* measured less true state */
    SIGNAL_SLEW      /* of every rotor, from command to command */
};

/* A bound on a signal: `quadsim.flight.audit.Limit`. */
typedef struct quadsim_bound {
    int64_t signal, axis;        /* axis: of a body rate, an error; the state of an estimate's error */
    int64_t terms, index[TERMS]; /* of a sum: states 0 to 11, rotor speeds 12 to 15 */
    double factor[TERMS];        /* of a sum's terms; the first: from SI to the bound's unit, of other signals */
    double lower, upper;         /* in the bound's unit; infinite: none */
    int64_t first, last;         /* physics steps of its window of time, both included */
} quadsim_bound;

/* A flown control period, as margins take it: `count` physics steps, in columns of a table, `width` numbers a row. */
typedef struct quadsim_period {
    const double *before;                    /* [14] MuJoCo's state at its start */
    const double *physics, *speeds, *thrust; /* columns: 14, 4, 1 */
    int64_t width, count, start;             /* start: the physics step at its start */
    const double *rotors;                    /* [4] rotor speeds at its end */
    const double *truth, *measured;          /* [12] states at its start */
    const double *reference;                 /* [4] x, y, z, yaw at its start */
    const double *commanded, *earlier;       /* [4] rotor speeds commanded at its end, and the period before */
    int64_t targeted;                        /* whether an inner loop has a target, whose thrust counts */
} quadsim_period;

/* The smallest margins [count] within a control period, its start left out, and those at its end; infinite where a
 * bound does not apply.  Signals that exist only at samples count at the start. */
void quadsim_margins(const quadsim_bound *bounds, int64_t count, const quadsim_period *period, double *smallest,
                     double *at_end);

/* A vehicle of a batch, all that it needs for a control period, and what comes of it. */
typedef struct quadsim_flight {
    quadsim_vehicle *vehicle;
    quadsim_inner *loop;      /* NULL: none */
    quadsim_sensing *sensing; /* NULL: none */
    quadsim_steps *rows;      /* of a period; the first is written anew where the last one was written before */
    int64_t period, steps;    /* physics steps of a period, and of this call, a part of it; 0: it does not fly */
    double command[8];        /* rotor speeds, or `numbers` of a target of the inner loop */
    int64_t numbers;
    double acting[ROTORS];  /* rotor speeds commanded at the end of the last period; then of this one */
    double reference[4];    /* at the start: x, y, z, yaw */
    double state[STATE];    /* the true one, at the start and then at the end */
    double measured[STATE]; /* at the start */
    double yaw, upright;    /* the last yaw, and the last upright one; see quadsim_observe */
    const quadsim_bound *bounds;
    int64_t bounded;
    double *smallest, *at_end;                            /* [bounded] margins */
    int64_t why;                                          /* it ended: enum quadsim_end */
    double before[PHYSICS], earlier[ROTORS], last[STATE]; /* MuJoCo's state, `acting` and `state` at the start */
    char complaint[128];                                  /* of MuJoCo, where it failed */
} quadsim_flight;

/* Fly flights [first, end) of an array, each by its steps; at the end of its period it has its state and margins. */
void quadsim_fly_many(quadsim_flight *flights, int64_t first, int64_t end);

#ifdef __cplusplus
}
#endif

#endif
