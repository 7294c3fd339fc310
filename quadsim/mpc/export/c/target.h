/* What the programs of this export need of the machine that they run on: posix.c and startup.c are two answers. */
#ifndef TARGET_H
#define TARGET_H

#include <stddef.h>
#include <stdint.h>

/* A clock, modulo 2^32, to be read at least twice a second.  POSIX: nanoseconds.  Cortex-M: SysTick, at the clock of
 * the processor; under QEMU with -icount shift=0 one tick is 40 instructions. */
uint32_t target_ticks(void);
extern const uint32_t target_ticks_per_ms;

/* Text for a person or a test.  POSIX: standard output.  Cortex-M: the debugger's console, by semihosting. */
void target_print(const char *text);

/* The serial line.  POSIX: standard input and output.  Cortex-M: the first UART of the board, polled, which does for the
 * emulated one: no byte is read during a step, so that a UART that holds few needs an interrupt that fills a buffer. */
int target_read(void); /* the next byte; -1 where none has come, after a millisecond at most */
void target_write(const void *bytes, size_t count);

#endif
