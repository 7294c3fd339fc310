/* Many vehicles under hostile commands, flown by several threads, each beside a copy that flies alone: the same bits,
 * and what ends one flight ends no other.  Arguments: threads, physics steps in all. */
#include <math.h>
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "quadsim_batch.h"

enum { COUNT = 48, PERIOD = 50, BOUNDS = 9, WIDTH = PHYSICS + 2 * ROTORS + 1 + WRENCH + 2, DELAY = 3 };

/* A vehicle with all its memory, on the heap, where the sanitizer sees both of its ends. */
typedef struct {
    quadsim_vehicle vehicle;
    quadsim_inner loop;
    quadsim_sensing sensing;
    quadsim_sensor sensor;
    quadsim_steps rows;
    quadsim_push push;
    double motion[MOTION], table[PERIOD][WIDTH], noise[PERIOD][ROTORS], disturbance[PERIOD][WRENCH];
    double queue[DELAY][ROTORS], samples[PERIOD + DELAY][3], curve[3][2], smallest[BOUNDS], at_end[BOUNDS];
    uint8_t faults[PERIOD + DELAY];
} craft;

static quadsim_flight flights[COUNT];
static craft *crafts[COUNT], *copies[COUNT];
static quadsim_bound bounds[BOUNDS];
static uint64_t seed = 88172645463325252u;

static double draw(void) /* uniform in [-1, 1) */
{
    seed ^= seed << 13;
    seed ^= seed >> 7;
    seed ^= seed << 17;
    return (double)(seed >> 11) / 4503599627370496.0 - 1.0;
}

/* A number near zero, far from it, or none. */
static double hostile(double scale)
{
    const double kind = draw();
    if (kind < 0.9) {
        return scale * draw();
    }
    if (kind < 0.94) {
        return scale * 1e9 * draw();
    }
    return kind < 0.96 ? (double)NAN : kind < 0.98 ? (double)INFINITY : 5e-324;
}

static void require(int holds, const char *what)
{
    if (!holds) {
        (void)fprintf(stderr, "violated: %s\n", what);
        abort();
    }
}

static void start(craft *c, int kind)
{
    static const double PLACE[ROTORS][3] = {{0.17, 0.0, 0.0}, {0.0, 0.17, 0.0}, {-0.17, 0.0, 0.01}, {0.0, -0.17, 0.0}};
    quadsim_vehicle *v = &c->vehicle;
    memset(c, 0, sizeof *c);
    v->motion = c->motion, v->velocity = c->motion + 7;
    c->motion[2] = 1.0, c->motion[3] = 1.0;
    v->timestep = 1e-3, v->plausible = 1e6, v->fastest_valid = 1e6;
    v->mass = 0.716, v->gravity = 9.81, v->hover = 453.0, v->fastest = kind % 3 ? 838.0 : (double)INFINITY;
    v->follows_motion = 1, v->rotor_drag = 1e-5, v->rise = 0.02, v->fall = 0.03, v->at_once = kind % 4 == 0;
    v->rotor_inertia = 1e-5;
    for (int i = 0; i < 3; i++) {
        v->inertia[i] = 0.007 + 0.005 * (i == 2);
        v->inverse[i][i] = 1.0 / v->inertia[i];
        v->linear_drag[i] = 0.1, v->quadratic_drag[i] = 0.01;
    }
    for (int i = 0; i < ROTORS; i++) {
        memcpy(v->place[i], PLACE[i], sizeof v->place[i]);
        v->coefficient[i] = 8.55e-6, v->efficiency[i] = 1.0, v->spin[i] = i % 2 ? 1.0 : -1.0, v->demand[i] = 1.0;
        v->torque_of_thrust[0][i] = PLACE[i][1], v->torque_of_thrust[1][i] = -PLACE[i][0];
        v->torque_of_thrust[2][i] = 0.016 * v->spin[i];
        v->speeds[i] = 453.0;
    }
    if (kind % 5 == 1) {
        c->curve[0][1] = 3.0, c->curve[1][0] = 0.5, c->curve[1][1] = 3.7, c->curve[2][0] = 1.0, c->curve[2][1] = 4.2;
        v->cells = 3.0, v->capacity = 2.2, v->resistance = 0.02, v->hover_current = 12.0, v->idle_current = 0.3;
        v->reference_voltage = 11.1, v->exponent = 2.0, v->curve = c->curve[0], v->points = 3, v->charge = 1.0;
    }
    if (kind % 5 == 2) {
        v->radius = 0.1, v->disc = 0.05, v->floor = 0.0;
        v->pushes = &c->push, v->pushing = 1, c->push.force[0] = 0.5, c->push.point[2] = 0.1;
    }
    if (kind % 5 == 3) {
        v->loss = 0.05, v->deviation = 0.1;
        for (int i = 0; i < ROTORS; i++) {
            v->largest[i] = 6.0;
        }
    }
    c->rows.noise = c->noise[0], c->rows.disturbance = c->disturbance[0];
    c->rows.physics = c->table[0], c->rows.speeds = c->table[0] + 14, c->rows.commands = c->table[0] + 18;
    c->rows.thrust = c->table[0] + 22, c->rows.wrench = c->table[0] + 23, c->rows.battery = c->table[0] + 29;
    c->rows.width = WIDTH;
    c->sensor.kind = RATES, c->sensor.stride = 1, c->sensor.latency = DELAY - 1;
    c->sensor.values = c->samples[0], c->sensor.faults = c->faults;
    c->sensing.sensors = &c->sensor, c->sensing.count = 1, c->sensing.attitude[0] = 1.0;
    c->loop.kind = AUTOPILOT, c->loop.stride = 1 + kind % 2, c->loop.measures = 1, c->loop.step = 1e-3;
    c->loop.gyro_share = 0.5, c->loop.d_share = 0.3, c->loop.airmode = kind % 3 != 1;
    c->loop.delay = kind % (DELAY + 1), c->loop.queue = c->queue[0];
    for (int i = 0; i < 3; i++) {
        c->loop.inertia[i] = v->inertia[i], c->loop.p[i] = 20.0, c->loop.i[i] = 5.0, c->loop.d[i] = 0.1;
        c->loop.i_max[i] = 10.0, c->loop.attitude[i] = 5.0, c->loop.largest[i] = 8.0;
    }
    for (int i = 0; i < ROTORS; i++) {
        c->loop.coefficient[i] = v->coefficient[i], c->loop.high[i] = 6.0, c->loop.quadratic[i] = 1.0;
        c->loop.to_thrusts[i][0] = 0.25, c->loop.to_thrusts[i][3] = v->spin[i] / (4.0 * 0.016);
        c->loop.to_thrusts[i][1] = PLACE[i][1] / (2.0 * 0.17 * 0.17);
        c->loop.to_thrusts[i][2] = -PLACE[i][0] / (2.0 * 0.17 * 0.17);
    }
}

static void engage(int k)
{
    quadsim_flight *f = flights + k;
    craft *c = crafts[k];
    start(c, k);
    start(copies[k], k);
    memset(f, 0, sizeof *f);
    f->vehicle = &c->vehicle, f->rows = &c->rows, f->period = PERIOD;
    f->loop = k % 2 ? &c->loop : NULL, f->sensing = k % 6 == 1 ? &c->sensing : NULL;
    f->bounds = bounds, f->bounded = BOUNDS, f->smallest = c->smallest, f->at_end = c->at_end;
}

/* Draws and a command of the next period, for a flight and its copy. */
static void provoke(int k)
{
    quadsim_flight *f = flights + k;
    craft *c = crafts[k], *copy = copies[k];
    f->steps = PERIOD, f->numbers = k % 4 == 3 ? 8 : 4;
    for (int i = 0; i < 8; i++) {
        f->command[i] = i == 0 && f->loop ? 7.0 + hostile(3.0) : f->loop ? hostile(1.0) : 453.0 + hostile(30.0);
    }
    for (int i = 0; i < 4; i++) {
        f->reference[i] = hostile(1.0);
        f->measured[i] = hostile(1.0);
    }
    for (int i = 0; i < PERIOD; i++) {
        for (int j = 0; j < WRENCH; j++) {
            c->disturbance[i][j] = k % 7 == 0 ? 0.01 * draw() : 0.0;
            c->noise[i][j % ROTORS] = draw();
        }
    }
    c->sensor.first = c->vehicle.now + 1 - c->sensor.latency;
    c->sensor.first = c->sensor.first < 0 ? 0 : c->sensor.first;
    if (c->sensor.heard < c->sensor.first) {
        c->sensor.heard = c->sensor.first;
    }
    copy->sensor = c->sensor;
    copy->sensor.values = copy->samples[0], copy->sensor.faults = copy->faults;
    memcpy(copy->disturbance, c->disturbance, sizeof c->disturbance);
    memcpy(copy->noise, c->noise, sizeof c->noise);
}

static int64_t fly_copy(int k)
{
    craft *c = copies[k];
    const quadsim_flight *f = flights + k;
    c->rows.row = 0;
    memcpy(c->loop.command, f->command, (size_t)f->numbers * sizeof(double));
    c->loop.holds_attitude = f->numbers > 4;
    return quadsim_fly(&c->vehicle, f->loop ? &c->loop : NULL, f->sensing ? &c->sensing : NULL, &c->rows, f->command,
                       c->vehicle.now + PERIOD);
}

typedef struct {
    int64_t first, end;
} range;

static void *fly_range(void *given)
{
    const range *r = given;
    quadsim_fly_many(flights, r->first, r->end);
    return NULL;
}

int main(int count, char **arguments)
{
    const int threads = count > 2 ? atoi(arguments[1]) : 1;
    const long long most = count > 2 ? atoll(arguments[2]) : 1000;
    long long flown = 0, ended = 0, completed = 0;
    require(threads >= 1 && threads <= COUNT, "threads");
    for (int k = 0; k < BOUNDS; k++) {
        bounds[k].signal = k < 8 ? k : SIGNAL_SUM;
        bounds[k].axis = k == SIGNAL_ESTIMATE ? 10 : k % 3;
        bounds[k].terms = k == 0 ? TERMS : 1;
        for (int j = 0; j < TERMS; j++) {
            bounds[k].index[j] = (j + k) % TERMS;
            bounds[k].factor[j] = 1.0;
        }
        bounds[k].lower = -1.0, bounds[k].upper = k % 2 ? 2.0 : (double)INFINITY;
        bounds[k].last = k == 3 ? 60 : INT64_MAX;
    }
    for (int k = 0; k < COUNT; k++) {
        crafts[k] = malloc(sizeof *crafts[k]);
        copies[k] = malloc(sizeof *copies[k]);
        require(crafts[k] && copies[k], "memory");
        engage(k);
    }
    while (flown < most) {
        pthread_t workers[COUNT];
        range ranges[COUNT];
        for (int k = 0; k < COUNT; k++) {
            provoke(k);
        }
        for (int t = 0; t < threads; t++) {
            ranges[t].first = (int64_t)COUNT * t / threads, ranges[t].end = (int64_t)COUNT * (t + 1) / threads;
            require(pthread_create(&workers[t], NULL, fly_range, &ranges[t]) == 0, "a thread");
        }
        for (int t = 0; t < threads; t++) {
            require(pthread_join(workers[t], NULL) == 0, "a thread's end");
        }
        for (int k = 0; k < COUNT; k++) {
            const int64_t why = fly_copy(k);
            const craft *one = crafts[k], *other = copies[k];
            flown += one->rows.row;
            require(why == flights[k].why, "the end of a flight alone");
            require(one->rows.row == other->rows.row, "steps of a flight alone");
            require(memcmp(one->motion, other->motion, sizeof one->motion) == 0, "the bits of a flight alone");
            require(memcmp(one->table, other->table, sizeof one->table) == 0, "the rows of a flight alone");
            if (why != QUADSIM_DONE) {
                ended++;
                engage(k);
            } else {
                completed++;
                require(isfinite(flights[k].state[0] + flights[k].state[4]), "a finite state");
            }
        }
    }
    (void)printf("%lld steps, %lld periods completed, %lld flights ended\n", flown, completed, ended);
    for (int k = 0; k < COUNT; k++) {
        free(crafts[k]);
        free(copies[k]);
    }
    return 0;
}
