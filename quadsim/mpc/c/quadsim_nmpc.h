/* Nonlinear model predictive control of a quadrotor: sequential quadratic programming, one or more steps per period.
 *
 * Each step linearises the rigid body along the stored plan, solves the quadratic program exactly, and keeps the new
 * plan.  All sizes and numbers of a vehicle are data: a quadsim_nmpc_problem, read only, which may be shared; what is
 * remembered is in a quadsim_nmpc_work and memory of the caller's, of quadsim_nmpc_reals(problem) reals and
 * quadsim_nmpc_ints(problem) ints.  Nothing is allocated, nothing is shared, there is no recursion, and of the C
 * library only memcpy, memmove and memset.
 *
 * States s: position [3], quaternion [4], velocity [3], body rates [3], actuators [0, 1 or 4], and, where moves have a
 * weight, the input before [4]; the quaternion is q_r* q inside the program, with the node's reference q_r, and q
 * itself in plans.  Inputs u [4] are shares. */
#ifndef QUADSIM_NMPC_H
#define QUADSIM_NMPC_H

#include "quadsim_core.h"

#ifdef __cplusplus
extern "C" {
#endif

#ifdef QUADSIM_FLOAT
#define quadsim_nmpc_start quadsim_nmpc_start_float
#endif

enum {
    QUADSIM_NMPC_BODY = 13,
    QUADSIM_NMPC_MOST = QUADSIM_NMPC_BODY + 8, /* states */
    QUADSIM_NMPC_SIDES = 12,                   /* of the polygon that bounds the tilt */
    QUADSIM_NMPC_LEFT = 8,                     /* columns of `left` */
    QUADSIM_NMPC_ENTRIES = 15 /* bounded quantities of a node: inputs, tilt, rates, position, velocity */
};

/* Numbers of a vehicle and its controller.
 *
 * Entries [w] of a node are its inputs [4], and at its end, each where `tilts`, `turns` or `places` is set, the thrust
 * axis along world x and y [2], body rates [3], and position and velocity [6].  A row that the caller states, of `rows`
 * in each node, is a sum of terms, each of an entry of this node, or of the one before, and has an upper bound. */
typedef struct quadsim_nmpc_term {
    quadsim_real coefficient;
    int entry, lag;
} quadsim_nmpc_term;

typedef struct quadsim_nmpc_problem {
    int horizon;              /* N nodes */
    int actuators;            /* states of actuators: none, 1 with targets, 4 with rotor lag */
    int targets;              /* whether inputs are thrust and body rates, not those of rotors */
    int speeds;               /* whether inputs are rotor speeds, not thrusts */
    int moments;              /* whether the air turns the body; not with targets */
    int substeps;             /* Runge-Kutta steps from node to node */
    int difference;           /* whether the attitude error is q - q_r, not 2 vec(q_r* q) */
    int shifts;               /* whether the plan moves on by a node from call to call */
    int moves;                /* whether steps of inputs have a weight */
    int tilts, turns, places; /* which entries there are */
    int rows;                 /* that the caller states, per node */
    int bound_nodes;          /* nodes whose bounds are stated; those of the last hold in all that follow */
    int faces;                /* at most so many half-spaces of positions, per node */
    int slacks;               /* of a node: of tilt, body rates and half-spaces, then those of rows */
    int capacity;             /* most active rows at a time */
    int changes;              /* of the active set in a search, after which it is given up */
    int iterations,
        corrections;        /* most SQP steps of a call; further ones, if the plan misses the dynamics by too much */
    quadsim_real tolerance; /* change of a state or input at which further steps end */
    quadsim_real converged; /* largest defect of a plan that has converged */
    quadsim_real step, gravity; /* time between nodes [s], [m/s^2] */
    quadsim_real largest;       /* thrust that is a share of 1 [N]: of a rotor, or with targets the weight */
    quadsim_real effect[16];  /* maps shares to T [m/s^2] and I^-1 tau; with targets its diagonal to T and body rates */
    quadsim_real gyration[3]; /* (Iyy - Izz) / Ixx, ... */
    quadsim_real moment[6], inflow[6], damping[9]; /* I^-1 torque: [3][2] of velocity along body x and y, per sum of the
                                                    * rotors' speeds as shares, and per velocity along z, and [3][3] of
                                                    * body rates, which it opposes */
    quadsim_real loss;        /* T per sum of the rotors' speeds as shares and velocity along z, which it opposes */
    quadsim_real lead[4];     /* targets: time constants over the step, for the reference, */
    quadsim_real hold[4];     /* and what a step's mean takes of them: 1, above it where an attitude is commanded */
    const quadsim_real *left; /* [2 substeps + 1][QUADSIM_NMPC_LEFT] after each half substep: what is left of a distance
                               * from the input [4]; of an attitude's targets, what the turn so far takes of them [4] */
    quadsim_real weight[QUADSIM_NMPC_MOST], effort[QUADSIM_INPUTS], move; /* diagonals of Q and R; of steps of inputs */
    const quadsim_real *terminal;                                         /* [n][n], symmetric */
    quadsim_real lower[QUADSIM_INPUTS], upper[QUADSIM_INPUTS];
    quadsim_real tilt, turn[3];             /* of the thrust axis along a side of the polygon, [rad/s] */
    const quadsim_nmpc_term *terms;         /* of all rows */
    const int *first;                       /* [rows + 1] the first term of each row */
    const quadsim_real *bounds;             /* [bound_nodes][rows] upper ones; 1e30: none */
    const int *slack;                       /* [rows] which slack a row has; -1: it is hard */
    const quadsim_real *linear, *quadratic; /* [slacks] leaving a bound by e costs l e + q e^2 / 2, not both
                                             * 0; l >= 1e30: hard */
} quadsim_nmpc_problem;

/* What is known of the surroundings in a period. */
typedef struct quadsim_nmpc_world {
    quadsim_real acceleration[3], angular[3]; /* disturbance [m/s^2] world, [rad/s^2] body */
    quadsim_real drag[3], square_drag[3];     /* over the mass, body axes [1/s], [1/m] */
    quadsim_real thrust_scale;
} quadsim_nmpc_world;

enum quadsim_nmpc_status {
    QUADSIM_NMPC_FREE = 0,          /* the optimum without bounds satisfies them all */
    QUADSIM_NMPC_BOUNDED = 1,       /* the optimum */
    QUADSIM_NMPC_UNCONVERGED = 2,   /* an optimum whose plan misses the dynamics by more than it should */
    QUADSIM_NMPC_INFEASIBLE = 3,    /* no plan satisfies all hard bounds */
    QUADSIM_NMPC_GIVEN_UP = 4,      /* too many changes of the active set, or too much rounding in it */
    QUADSIM_NMPC_OVER_CAPACITY = 5, /* too many active rows */
    QUADSIM_NMPC_NOT_FINITE = 6
};

/* What a row bounds. */
enum quadsim_nmpc_kind {
    QUADSIM_NMPC_INPUT,
    QUADSIM_NMPC_TILT,   /* the thrust axis, by a side of the polygon */
    QUADSIM_NMPC_RATE,   /* body rates */
    QUADSIM_NMPC_STATED, /* what the caller states */
    QUADSIM_NMPC_FACE,   /* a position, by a half-space */
    QUADSIM_NMPC_SLACK   /* at least zero */
};

/* A row of a program. */
typedef struct quadsim_nmpc_row {
    int node;
    int kind;  /* of enum quadsim_nmpc_kind */
    int index; /* of the input, side, axis, stated row, half-space or slack */
    int sign;  /* 1: an upper bound; -1: a lower one */
    int slack; /* which one it has of all nodes' [N][slacks]; -1: none */
} quadsim_nmpc_row;

typedef struct quadsim_nmpc_work {
    const quadsim_nmpc_problem *p;
    int planned;       /* whether there is a plan */
    int shifted;       /* whether the active set is to be moved on by a node */
    int doubtful;      /* whether the plan has not converged, where inputs are targets: it is a rollout then */
    int iterations;    /* SQP steps of the last call */
    int count;         /* active rows */
    int changes;       /* of the active set in the last program */
    int rounds, inner; /* of holding and releasing inputs in it, and of the interior point method */
    int patience;      /* see relax in quadsim_nmpc.c */
    int allowed;       /* changes of the active set in the present search */
    int ends;          /* the caller's, between _begin and _keep: whether no SQP step is to follow, as time is up */
    quadsim_real defect, moved,
        violation; /* of the plan; the largest violation of a row by the optimum, less its slack */
    quadsim_real share, largest, least;
    quadsim_real measured[QUADSIM_NMPC_MOST]; /* state, with the input before */
    quadsim_real start[QUADSIM_NMPC_MOST];    /* the same, its quaternion in the first frame */
    quadsim_real before[QUADSIM_INPUTS];
    quadsim_real *x, *u;              /* the plan [N+1][n], [N][4] */
    quadsim_real *frame;              /* [N+1][4] reference quaternions */
    quadsim_real *goal, *aim;         /* [N+1][n] of states, [N][4] of inputs */
    quadsim_real *face, *beyond;      /* [N][faces][3] normals of half-spaces normal . p <= beyond, [N][faces] */
    quadsim_real *map, *offset, *end; /* [N][13][W] slopes; [N][n] c; [N][n] next states */
    quadsim_real *axis, *known;       /* [N][2][4], [N][2] of the thrust axis at the end of a step */
    quadsim_real *gain, *inverse, *feed, *more; /* [N][4][n], [N][16], [N][4], [N][4] */
    quadsim_real *s, *v;                        /* the optimum [N+1][n], [N][4]; quaternions in their frames */
    quadsim_real *value;                        /* [N+1][w] of entries at the present multipliers, those before first */
    quadsim_real *own, *response; /* [N+1][w]; [capacity][N+1][w], or what the recursion and the interior point
                                   * method keep there */
    quadsim_real *factor, *multiplier, *r, *d; /* L D L' of the active rows, row by row; [capacity] each */
    quadsim_real *price, *rate, *origin;      /* [N][slacks] sums of multipliers, and of their slopes; see the search */
    quadsim_real *x_before, *u_before, *last; /* the plan before a step, and [N][4] the step before; or candidates */
    quadsim_nmpc_row *row;                    /* [capacity] active rows */
    int *free;                                /* [N][slacks] whether a slack may be positive */
    int *held;                                /* [N][4] inputs at bounds: 1 above, -1 below */
} quadsim_nmpc_work;

long quadsim_nmpc_reals(const quadsim_nmpc_problem *problem);
long quadsim_nmpc_ints(const quadsim_nmpc_problem *problem);

/* A work without a plan, in memory of the caller's. */
void quadsim_nmpc_start(quadsim_nmpc_work *work, const quadsim_nmpc_problem *problem, quadsim_real *reals, int *ints);

/* Forget the plan and the active set. */
void quadsim_nmpc_reset(quadsim_nmpc_work *work);

/* The plan from the measured state [13 and actuators] after the input before [4], along reference states [N+1][13] and
 * rotor thrusts [N][4] in newton.  Its first input is work->u; where there is no optimum, the plan is forgotten.
 *
 * It is quadsim_nmpc_begin, then for each SQP step _linearise, _solve and _keep, until there is no other.  The caller
 * may call these itself, to solve a program again with other half-spaces. */
enum quadsim_nmpc_status quadsim_nmpc_step(quadsim_nmpc_work *work, const quadsim_nmpc_world *world,
                                           const quadsim_real *measured, const quadsim_real *before,
                                           const quadsim_real *states, const quadsim_real *thrusts);

/* Take the measured state and the reference; 0 where numbers are not finite. */
int quadsim_nmpc_begin(quadsim_nmpc_work *work, const quadsim_nmpc_world *world, const quadsim_real *measured,
                       const quadsim_real *before, const quadsim_real *states, const quadsim_real *thrusts);

void quadsim_nmpc_linearise(quadsim_nmpc_work *work, const quadsim_nmpc_world *world);

/* The optimum of the program, in work->s and work->v. */
enum quadsim_nmpc_status quadsim_nmpc_solve(quadsim_nmpc_work *work);

/* Keep the optimum as the plan; whether another SQP step should follow.  *status is that of the optimum, and becomes
 * that of the plan. */
int quadsim_nmpc_keep(quadsim_nmpc_work *work, const quadsim_nmpc_world *world, enum quadsim_nmpc_status *status);

/* Slopes [13][W] of the next state in all states but the position, in the frames [2][4] of a step's start and end, then
 * in the inputs, padded to an even number W of columns; and the next state [n]. */
void quadsim_nmpc_slopes(const quadsim_nmpc_problem *problem, const quadsim_nmpc_world *world,
                         const quadsim_real *state, const quadsim_real *inputs, const quadsim_real *frames,
                         quadsim_real *slopes, quadsim_real *next);

/* Next states [count][n] of states and inputs [count][4]; a step, its substeps and lags are the problem's. */
void quadsim_nmpc_advance(const quadsim_nmpc_problem *problem, const quadsim_nmpc_world *world, int count,
                          const quadsim_real *states, const quadsim_real *inputs, quadsim_real *ends);

/* The angular acceleration [3] by the air's torque in a state [13] with thrusts of the rotors [4] in newton; returns
 * how much of T is lost to inflow. */
quadsim_real quadsim_nmpc_turned(const quadsim_nmpc_problem *problem, const quadsim_real *state,
                                 const quadsim_real *thrusts, quadsim_real *turned);

#ifdef __cplusplus
}
#endif

#endif
