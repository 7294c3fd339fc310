/* A POSIX system as a target. */
#define _POSIX_C_SOURCE 200809L /* NOLINT: POSIX reserves it for this */
#include "target.h"

#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

const uint32_t target_ticks_per_ms = 1000000U;

uint32_t target_ticks(void)
{
    struct timespec now = {0, 0};
    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint32_t)now.tv_sec * 1000000000U + (uint32_t)now.tv_nsec;
}

void target_print(const char *text)
{
    (void)fputs(text, stdout);
}

int target_read(void)
{
    unsigned char byte = 0;
    struct pollfd line = {STDIN_FILENO, POLLIN, 0};
    if (poll(&line, 1, 1) < 1) {
        return -1;
    }
    if (read(STDIN_FILENO, &byte, 1) < 1) { /* the other end has closed */
        exit(0);
    }
    return byte;
}

void target_write(const void *bytes, size_t count)
{
    const unsigned char *rest = bytes;
    while (count > 0) {
        const ssize_t written = write(STDOUT_FILENO, rest, count);
        if (written < 1) {
            exit(1);
        }
        rest += written;
        count -= (size_t)written;
    }
}
