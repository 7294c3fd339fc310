/* What happens at the physics rate: rotors, battery, forces, inner loop and sensors around MuJoCo's step or an own
 * Runge-Kutta step, and the error-state filter over the samples of a control period.
 *
 * All memory is the caller's, and every draw of a random number comes in from outside.  SI units; world and body
 * frames, quaternions wxyz, body to world, and a motion of 13 numbers (position, quaternion, velocity, body rates) as
 * MuJoCo has them.  A step depends on the state at its start alone, so that results have the same bits however time is
 * cut into calls.  Equations and sources: `quadsim.sim.effects`, `quadsim.sim.autopilot`, `quadsim.sim.estimator`. */
#ifndef QUADSIM_PLANT_H
#define QUADSIM_PLANT_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

enum { ROTORS = 4, MOTION = 13, PHYSICS = 14, WRENCH = 6, ERRORS = 15, MEAN = 16, SENSORS = 4 };

/* Why quadsim_fly returned. */
enum quadsim_end {
    QUADSIM_DONE,     /* it has come to the step that was asked for */
    QUADSIM_DUE,      /* the inner loop is the caller's to answer */
    QUADSIM_INVALID,  /* the inner loop's answer is not four speeds */
    QUADSIM_DIVERGED, /* the last step's state is not finite, or not plausible */
    QUADSIM_FAILED    /* MuJoCo gave up; see quadsim_complaint */
};

enum { POSITION, VELOCITY, ATTITUDE, RATES }; /* kinds of sensors, in the order of `SensorName` */
enum { OUTSIDE, AUTOPILOT, INDI };            /* who answers for an inner loop; OUTSIDE: the caller */

/* A force, world [N], at a point of the body [m]. */
typedef struct quadsim_push {
    double force[3], point[3];
} quadsim_push;

/* The vehicle: constants, what events change, and its state. */
typedef struct quadsim_vehicle {
    /* MuJoCo's step, and what it reads and writes; NULL `step`: the own method, on motion and velocity alone. */
    void (*step)(const void *model, void *data);
    const void *model;
    void *data;
    double *motion, *velocity, *applied, *control; /* qpos, qvel, qfrc_applied, ctrl: 7, 6, 6, 4 */
    double *wind, *obstacles;                      /* option.wind, mocap_pos; NULL where nothing changes them */
    const double *fluid;                           /* qfrc_fluid; NULL where MuJoCo does not drag the body */
    int64_t mocaps;
    double timestep, plausible, fastest_valid; /* largest magnitudes of a state, and of an inner loop's answer */

    /* constants */
    double mass, gravity, inertia[3], products[3], inverse[3][3], torque_of_thrust[3][ROTORS]; /* of the own method */
    double linear, coefficient[ROTORS];          /* of a rotor's thrust: linear w + coefficient w^2 */
    double hover, demand[ROTORS], linear_demand; /* of power, at hover speed, over the mean rotor's in hover */
    double slowest, fastest, place[ROTORS][3], spin[ROTORS];
    double rotor_drag, rotor_inertia, rotor_moment[2], inflow_moment[2], rate_damping[3], linear_drag[3];
    double quadratic_drag[3], inflow;
    double floor, disc, radius;              /* of the ground effect; radius 0: none */
    double loss, deviation, largest[ROTORS]; /* of thrust noise; largest 0: none */
    double cells, capacity, resistance, hover_current, idle_current, reference_voltage, exponent; /* cells 0: none */
    const double *curve; /* [points][2] charge and voltage of a cell */
    int64_t points;
    int64_t follows_motion; /* 0: no force but the rotors' */

    /* what events change */
    double rise, fall, acceleration, efficiency[ROTORS]; /* acceleration 0: no limit */
    int64_t at_once;                                     /* rotors have their commanded speed at once */
    const quadsim_push *pushes;
    int64_t pushing;

    /* state, beside the motion */
    int64_t now; /* physics step */
    double time, speeds[ROTORS], target[ROTORS], before[6], charge;
} quadsim_vehicle;

/* An inner loop.  Its owner fills the constants, resets the state, and sets `until` to 0 when it comes into force. */
typedef struct quadsim_inner {
    int64_t kind, stride, until, measures; /* steps between calls, and to the next; whether it hears sensors */
    double command[8], answer[ROTORS];
    int64_t holds_attitude;
    double step, inertia[3], products[3], integral[3], filtered[3], slope[3];
    /* autopilot; thrusts over four times the rotor's share of the weight, so that hover is the same for all */
    double p[3], i[3], d[3], i_max[3], attitude[3], largest[3], gyro_share, d_share;
    double to_thrusts[ROTORS][4], coefficient[ROTORS], low[ROTORS], high[ROTORS];
    /* a thrust over its coefficient: linear w + quadratic w^2, just w^2 unless the vehicle has a map of thrust */
    double linear[ROTORS], quadratic[ROTORS];
    int64_t airmode, delay, oldest;
    double *queue; /* [delay][4] */
    /* incremental nonlinear dynamic inversion */
    double effect[4][ROTORS], inverse[ROTORS][4], scale[4], omega, least[ROTORS], most[ROTORS];
    double last_time, last_rates[3];
    int64_t started;
} quadsim_inner;

/* A sensor: sample j is taken at step j * stride and arrives `latency` later.  The arrays start at sample `first`. */
typedef struct quadsim_sensor {
    int64_t kind, stride, latency, first, heard; /* heard: the next sample to be heard */
    double *values;                              /* [n][3] errors come in, samples go out */
    const uint8_t *faults;                       /* [n] sums of LOST, FROZEN, and NO_NUMBER << axis */
    double held[3], through[3];                  /* the sample heard last; the one that a frozen sensor repeats */
    int64_t passed;                              /* whether `through` is a sample */
} quadsim_sensor;

enum { LOST = 1, FROZEN = 2, NO_NUMBER = 4 };

/* What an inner loop measures: the newest finite attitude and rates; the bias is subtracted from a sensor's rates. */
typedef struct quadsim_sensing {
    quadsim_sensor *sensors;
    int64_t count;
    double bias[3], attitude[4], rates[3];
} quadsim_sensing;

/* Draws and results of the physics steps of a control period.  Results are columns of one table, `width` numbers a row;
 * a column that is NULL is not written, a draw that is NULL is not made. */
typedef struct quadsim_steps {
    const double *noise, *disturbance, *obstacles; /* [M][4] standard normal, [M][6], [M][mocaps][3] */
    const double *wind;                            /* column of the table: 3, comes in */
    double *physics, *speeds, *commands, *thrust, *wrench, *battery; /* columns: 14, 4, 4, 1, 6, 2 */
    int64_t width, row;                                              /* row: the next */
} quadsim_steps;

/* Fly to physics step `end` under a command [4] of rotor speeds, or under an inner loop. */
int64_t quadsim_fly(quadsim_vehicle *v, quadsim_inner *loop, quadsim_sensing *sensed, quadsim_steps *rows,
                    const double *command, int64_t end);

/* The handler of MuJoCo's fatal errors while it steps for quadsim_fly; elsewhere it does as MuJoCo does without one. */
void quadsim_trap(const char *message);
const char *quadsim_complaint(void);

/* MuJoCo's states [count][14], `width` numbers a row, as the paper's [count][12]: Euler angles, body to world, and
 * their rates; the yaw unwrapped along the rows, as by `quadsim.state.YawUnwrapper`, from the turn nearest to `yaw`. */
void quadsim_states(const double *physics, int64_t count, int64_t width, double yaw, double *states);

/* One of them, from MuJoCo's [14], on the turn of the yaw nearest the last one, or upright the last upright one. */
void quadsim_observe(const double *physics, double *last, double *upright, double *state);

/* Its parts: the turn of the yaw of Euler angles [3], which stays where one is not finite; rates of Euler angles [3]
 * from body rates [3]. */
void quadsim_turn(const double *euler, double *last, double *upright);
void quadsim_euler_rates(const double *euler, const double *rate, double *rates);

/* Take the samples of step `now` at a motion [13]; hear what has arrived by step `now`. */
void quadsim_sense(quadsim_sensing *sensed, int64_t now, const double *motion);
void quadsim_hear(quadsim_sensing *sensed, int64_t now, const double *motion);

/* Let an inner loop answer, from time, body rates [3], rotor speeds [4] and attitude [4]. */
void quadsim_answer(quadsim_inner *loop, double time, const double *rates, const double *rotors,
                    const double *attitude);

/* The rotor speeds [4] within the loop's bounds whose wrench is closest to a demanded one [4]; `mpc.allocation`. */
void quadsim_allocate(const quadsim_inner *loop, const double *wrench, double *speeds);

/* ---- the error-state filter -------------------------------------------------------------------------------------- */

typedef struct quadsim_filter {
    double timestep, mass, gravity, inertia[3], products[3], inverse[3][3], allocation[4][ROTORS];
    double rotor_moment[2], inflow_moment[2], rate_damping[3], inflow;
    double density[5];                                            /* of white noise on the five blocks of the error */
    double variance[SENSORS][3], initial[ERRORS], gate, patience; /* patience in steps */
    int64_t stride;                                               /* longest prediction, in steps */
} quadsim_filter;

/* The filter at a step. */
typedef struct quadsim_track {
    int64_t step;
    double mean[MEAN], P[ERRORS][ERRORS];
    int64_t refused[SENSORS], accepted[SENSORS], rejected[SENSORS]; /* refused: since this step; -1: not */
    double nis[SENSORS];
} quadsim_track;

typedef struct quadsim_sample {
    int64_t taken, kind;
    double value[3];
} quadsim_sample;

/* Use samples in their order, then predict to step `until` unless that is past.  Row s of `commands` [4] and `grounded`
 * is that of step base + s. */
void quadsim_filter_run(const quadsim_filter *f, quadsim_track *t, const quadsim_sample *samples, int64_t count,
                        const double *commands, const uint8_t *grounded, int64_t base, int64_t until);

#ifdef __cplusplus
}
#endif

#endif
