/* What the programs of an export need of WebAssembly: a console that the host imports, and three functions of libc. */
#include <string.h>

#include "target.h"

const uint32_t target_ticks_per_ms = 1;

uint32_t target_ticks(void)
{
    return 0;
}

void *memcpy(void *restrict to, const void *restrict from, size_t bytes)
{
    return memmove(to, from, bytes);
}

void *memmove(void *to, const void *from, size_t bytes)
{
    char *target = to;
    const char *source = from;
    size_t i;
    for (i = 0; target < source && i < bytes; i++) {
        target[i] = source[i];
    }
    for (i = bytes; target > source && i > 0; i--) {
        target[i - 1] = source[i - 1];
    }
    return to;
}

void *memset(void *to, int value, size_t bytes)
{
    char *target = to;
    while (bytes-- > 0) {
        *target++ = (char)value;
    }
    return to;
}
