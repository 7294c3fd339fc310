/* What happens at the physics rate: rotors, battery, forces, inner loop and sensors around a step of the rigid body,
 * which MuJoCo or a Runge-Kutta method of our own takes; and the error-state filter over the samples of a control
 * period.
 *
 * All memory is the caller's, and every random number is drawn by the caller.  Units are SI.  Quaternions are wxyz,
 * body to world.  A motion is 13 numbers, as MuJoCo has them: position, quaternion, velocity (world), body rates (body
 * frame). A step depends on the state at its start alone, so that results have the same bits however time is cut into
 * calls. Equations and sources: `quadsim.sim.effects`, `quadsim.sim.autopilot`, `quadsim.sim.estimator`. */
#ifndef QUADSIM_PLANT_H
#define QUADSIM_PLANT_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

enum { ROTORS = 4, MOTION = 13, PHYSICS = 14, WRENCH = 6, SENSORS = 4 }; /* PHYSICS: time and motion */
enum { ERRORS = 15, MEAN = 16 };                                         /* of the filter's error and its mean */

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
    /* MuJoCo's step, its arguments, and the arrays of `data` that the plant reads and writes.  Without a step, the
     * plant takes its own, on motion and velocity alone. */
    void (*step)(const void *model, void *data);
    const void *model;
    void *data;
    double *motion;      /* qpos: position and quaternion; without MuJoCo, the whole motion */
    double *velocity;    /* qvel: velocity and body rates */
    double *applied;     /* qfrc_applied: force and torque of all effects */
    double *control;     /* ctrl: thrusts of the rotors */
    double *wind;        /* option.wind; NULL where nothing changes it */
    double *obstacles;   /* mocap_pos; NULL where nothing changes it */
    const double *fluid; /* qfrc_fluid; NULL where MuJoCo does not drag the body */
    int64_t mocaps;      /* number of obstacles */
    double timestep;
    double plausible;     /* largest magnitude of a number of the state */
    double fastest_valid; /* largest magnitude of an inner loop's answer */

    /* Constants.  The plant's own step uses mass, gravity, inertia and the torques of thrust. */
    double mass, gravity;
    double inertia[3], products[3], inverse[3][3]; /* diagonal, xy xz yz, inverse of the matrix */
    double torque_of_thrust[3][ROTORS];
    double linear, coefficient[ROTORS];          /* thrust: linear w + coefficient w^2 */
    double hover, demand[ROTORS], linear_demand; /* power: (linear_demand + demand u) u^2 with u = w / hover */
    double slowest, fastest;                     /* bounds of commanded speeds */
    double place[ROTORS][3];
    double spin[ROTORS]; /* signs of the reaction torques */
    double rotor_drag, rotor_inertia;
    double rotor_moment[2], inflow_moment[2]; /* about x and y */
    double rate_damping[3], linear_drag[3], quadratic_drag[3];
    double inflow;                           /* thrust that a rotor loses over w and axial velocity */
    double floor, disc, radius;              /* ground effect: heights of floor and discs, rotors' radius; 0: none */
    double loss, deviation, largest[ROTORS]; /* noise of thrust, relative to the largest thrust; 0: none */
    double cells, capacity, resistance;      /* battery; cells 0: none */
    double hover_current, idle_current;      /* of the whole vehicle */
    double reference_voltage, exponent;      /* thrust has the factor (voltage / reference_voltage)^exponent */
    const double *curve;                     /* [points][2] charge and voltage of a cell */
    int64_t points;
    int64_t follows_motion; /* whether forces besides thrust are computed from the motion */

    /* What events change. */
    double rise, fall, acceleration; /* of rotors: time constants, largest acceleration or 0 */
    double efficiency[ROTORS];
    int64_t at_once; /* whether rotors have their commanded speed at once */
    const quadsim_push *pushes;
    int64_t pushing; /* number of pushes */

    /* State, beside the motion. */
    int64_t now; /* the physics step that comes next */
    double time, speeds[ROTORS], target[ROTORS];
    double before[6]; /* the velocity a step ago */
    double charge;
} quadsim_vehicle;

/* An inner loop.  Its owner fills the constants, resets the state, and sets `until` to 0 when it comes into force. */
typedef struct quadsim_inner {
    int64_t kind;
    int64_t stride;   /* physics steps between calls */
    int64_t until;    /* and to the next call */
    int64_t measures; /* whether it receives the sensors' samples, else the true attitude and rates */
    double command[8], answer[ROTORS];
    int64_t holds_attitude; /* whether the command has an attitude to hold */
    double step;            /* time between calls */
    double inertia[3], products[3];
    double integral[3];
    double filtered[3], slope[3]; /* of a filter: body rates of the autopilot, torque missed of INDI; and its slope */

    /* The autopilot.  Its thrusts are over four times the rotor's share of the weight: in hover, all are equal. */
    double p[3], i[3], d[3], i_max[3], attitude[3]; /* gains, and bounds of the integral */
    double largest[3];                              /* largest commanded rates */
    double gyro_share, d_share;   /* of a change, which filters of rates and of slopes take in a step */
    double to_thrusts[ROTORS][4]; /* from collective thrust and torques */
    double coefficient[ROTORS], low[ROTORS], high[ROTORS]; /* of a thrust, and its bounds */
    double linear[ROTORS], quadratic[ROTORS]; /* a thrust over its coefficient: linear w + quadratic w^2, or just w^2 */
    int64_t airmode;                          /* whether collective thrust gives way to torque */
    int64_t delay;                            /* calls until an answer acts */
    int64_t oldest;                           /* row of the queue */
    double *queue;                            /* [delay][4] answers under way */

    /* Incremental nonlinear dynamic inversion, and the allocation, whose variables are thrusts over coefficients. */
    double effect[4][ROTORS], inverse[ROTORS][4]; /* from these to a wrench, and back */
    double scale[4];                              /* of the wrench */
    double omega;                                 /* cut-off of the filter [rad/s] */
    double least[ROTORS], most[ROTORS];           /* bounds of speeds */
    double last_time, last_rates[3];
    int64_t started; /* whether there is a last call */
} quadsim_inner;

/* A sensor: sample j is taken at step j * stride and arrives `latency` later.  The arrays start at sample `first`. */
typedef struct quadsim_sensor {
    int64_t kind, stride, latency; /* in physics steps */
    int64_t first;
    int64_t heard;         /* the next sample to be heard */
    double *values;        /* [n][3] the errors of samples, which the samples replace */
    const uint8_t *faults; /* [n] a sum of LOST, FROZEN, and NO_NUMBER << axis */
    double held[3];        /* the sample heard last */
    double through[3];     /* the sample that a frozen sensor repeats */
    int64_t passed;        /* whether `through` is a sample */
} quadsim_sensor;

enum { LOST = 1, FROZEN = 2, NO_NUMBER = 4 }; /* what happens to a sample */

/* What an inner loop measures: the newest finite attitude and rates; the bias is subtracted from a sensor's rates. */
typedef struct quadsim_sensing {
    quadsim_sensor *sensors;
    int64_t count;
    double bias[3], attitude[4], rates[3];
} quadsim_sensing;

/* Draws and results of the physics steps of a control period, of which there are M.  A draw that is NULL is not made.
 * Results are columns of one table with `width` numbers a row; a column that is NULL is not written. */
typedef struct quadsim_steps {
    const double *noise;       /* [M][4] standard normal numbers, for thrusts */
    const double *disturbance; /* [M][6] force and torque */
    const double *obstacles;   /* [M][mocaps][3] positions */
    const double *wind;        /* a column of the table that comes in: 3 numbers */
    double *physics;           /* columns that go out: 14 numbers, */
    double *speeds;            /* 4, */
    double *commands;          /* 4, */
    double *thrust;            /* 1, */
    double *wrench;            /* 6, */
    double *battery;           /* 2 */
    int64_t width;
    int64_t row; /* the row of the next step */
} quadsim_steps;

/* Fly to physics step `end` under a command [4] of rotor speeds, or under an inner loop. */
int64_t quadsim_fly(quadsim_vehicle *v, quadsim_inner *loop, quadsim_sensing *sensed, quadsim_steps *rows,
                    const double *command, int64_t end);

/* The handler of MuJoCo's fatal errors.  Within quadsim_fly it ends the flight; elsewhere it ends the process, as
 * MuJoCo does without a handler. */
void quadsim_trap(const char *message);

/* The message of the last fatal error in this thread. */
const char *quadsim_complaint(void);

/* Convert MuJoCo's states [count][14], `width` numbers a row, to the paper's [count][12], which have Euler angles and
 * their rates.  The yaw is unwrapped along the rows, as by `quadsim.state.YawUnwrapper`, from the turn nearest to
 * `yaw`.
 */
void quadsim_states(const double *physics, int64_t count, int64_t width, double yaw, double *states);

/* Convert one of them; `last` and `upright` are those of quadsim_turn. */
void quadsim_observe(const double *physics, double *last, double *upright, double *state);

/* Unwrap the yaw of Euler angles [3] into `last`: an upright one to the last upright yaw, which it then is, another to
 * the last yaw.  Both stay where an angle is not finite. */
void quadsim_turn(const double *euler, double *last, double *upright);

/* Rates of Euler angles [3] from body rates [3]. */
void quadsim_euler_rates(const double *euler, const double *rate, double *rates);

/* Take the samples of step `now` at a motion [13]. */
void quadsim_sense(quadsim_sensing *sensed, int64_t now, const double *motion);

/* Update what an inner loop measures by the samples that have arrived by step `now`. */
void quadsim_hear(quadsim_sensing *sensed, int64_t now, const double *motion);

/* Let an inner loop answer, from time, body rates [3], rotor speeds [4] and attitude [4]. */
void quadsim_answer(quadsim_inner *loop, double time, const double *rates, const double *rotors,
                    const double *attitude);

/* The rotor speeds [4] within the loop's bounds whose wrench is closest to a demanded one [4]; `mpc.allocation`. */
void quadsim_allocate(const quadsim_inner *loop, const double *wrench, double *speeds);

/* ---- the error-state filter -------------------------------------------------------------------------------------- */

typedef struct quadsim_filter {
    double timestep, mass, gravity;
    double inertia[3], products[3], inverse[3][3]; /* diagonal, xy xz yz, inverse of the matrix */
    double allocation[4][ROTORS];                  /* from squared speeds to thrust and torques */
    double rotor_moment[2], inflow_moment[2], rate_damping[3], inflow;
    double density[5];           /* of white noise on the five blocks of the error */
    double variance[SENSORS][3]; /* of the sensors' samples */
    double initial[ERRORS];      /* standard deviations of the first estimate's error */
    double gate;                 /* largest r' S^-1 r of a sample that is used */
    double patience;             /* steps of refused samples after which one is used, at a larger variance */
    int64_t stride;              /* steps of the longest prediction */
} quadsim_filter;

/* The filter at a step. */
typedef struct quadsim_track {
    int64_t step;
    double mean[MEAN], P[ERRORS][ERRORS];
    int64_t refused[SENSORS];                     /* the step since which samples are refused; -1: they are not */
    int64_t accepted[SENSORS], rejected[SENSORS]; /* numbers of samples */
    double nis[SENSORS];                          /* sums of r' S^-1 r */
} quadsim_track;

/* A sample: the step at which it was taken, the kind of sensor, and its value. */
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
