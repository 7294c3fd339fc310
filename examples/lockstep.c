/* A simulated clock, and turns in place of concurrency, for Betaflight's SITL and programs like it: they take their
   time from clock_gettime(CLOCK_MONOTONIC) and nanosleep, and receive in threads that wait in select.

   LOCKSTEP="R,W,ADDRESS" LD_PRELOAD=./lockstep.so PROGRAM

   The clock advances by TICK_NS with each look of the main thread at it, and by the length of each of its sleeps, which
   take no time.  At a limit the main thread writes `d` (done) to the file descriptor W and waits for the next limit on
   R (8 bytes, ns).  Other threads run only while it waits there; one that has dealt with a datagram writes `p`
   (processed).  So whoever sends a datagram and waits for `p`, then sets a limit and waits for `d`, meets the same
   state every time.  Servers on all interfaces, a command line among them, listen on the loopback ADDRESS instead. */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <dlfcn.h>
#include <errno.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/select.h>
#include <time.h>
#include <unistd.h>

enum { TICK_NS = 500, SECOND_NS = 1000000000 };
#define NEXT(function) ((__typeof__(&function))dlsym(RTLD_NEXT, #function))

static uint64_t now_ns = SECOND_NS, limit_ns = SECOND_NS;
static int limits, reports; /* file descriptors */
static struct in_addr loopback;
static pthread_mutex_t turn = PTHREAD_MUTEX_INITIALIZER;
static sem_t begun;
static _Thread_local enum { BEGINS, HANDLES, WAITS, MAIN } role = BEGINS;

__attribute__((constructor)) static void start(void)
{
    const char *settings = getenv("LOCKSTEP");
    char address[16];
    if (!settings || sscanf(settings, "%d,%d,%15s", &limits, &reports, address) != 3)
        abort();
    if (!inet_aton(address, &loopback))
        abort();
    role = MAIN;
    sem_init(&begun, 0, 0);
    pthread_mutex_lock(&turn);
}
static void report(char what)
{
    if (write(reports, &what, 1) != 1)
        _exit(3); /* nobody listens any more */
}
static void advance(uint64_t ns)
{
    for (now_ns += ns; now_ns >= limit_ns; pthread_mutex_lock(&turn)) {
        pthread_mutex_unlock(&turn);
        report('d');
        if (read(limits, &limit_ns, sizeof limit_ns) != sizeof limit_ns)
            _exit(3);
    }
}
int clock_gettime(clockid_t clock, struct timespec *time)
{
    if (clock != CLOCK_MONOTONIC)
        return NEXT(clock_gettime)(clock, time);
    if (role == MAIN)
        advance(TICK_NS);
    *time = (struct timespec){now_ns / SECOND_NS, now_ns % SECOND_NS};
    return 0;
}
int nanosleep(const struct timespec *length, struct timespec *remaining)
{
    if (role != MAIN)
        return NEXT(nanosleep)(length, remaining);
    advance((uint64_t)length->tv_sec * SECOND_NS + length->tv_nsec);
    return 0;
}
int pthread_create(pthread_t *thread, const pthread_attr_t *attributes, void *(*run)(void *), void *argument)
{
    int error = NEXT(pthread_create)(thread, attributes, run, argument);
    return error ? error : sem_wait(&begun); /* until it waits for the first time */
}
int pthread_join(pthread_t thread, void **result)
{
    return (void)thread, (void)result, 0;
} /* called only before exit */
int select(int count, fd_set *readable, fd_set *writable, fd_set *failed, struct timeval *patience)
{
    if (role == BEGINS)
        sem_post(&begun);
    else
        pthread_mutex_unlock(&turn);
    if (role == HANDLES)
        report('p');
    role = WAITS;
    int ready = NEXT(select)(count, readable, writable, failed, patience);
    pthread_mutex_lock(&turn);
    return ready;
}
ssize_t recvfrom(int fd, void *data, size_t size, int flags, struct sockaddr *from, socklen_t *length)
{
    ssize_t received = NEXT(recvfrom)(fd, data, size, flags, from, length);
    if (received > 0)
        role = HANDLES;
    return received;
}
int bind(int fd, const struct sockaddr *address, socklen_t length)
{
    struct sockaddr_in here = {.sin_family = AF_INET, .sin_addr = loopback};
    if (address->sa_family != AF_INET || length < sizeof here)
        return errno = EAFNOSUPPORT, -1;
    here.sin_port = ((const struct sockaddr_in *)address)->sin_port;
    return NEXT(bind)(fd, (struct sockaddr *)&here, sizeof here);
}
