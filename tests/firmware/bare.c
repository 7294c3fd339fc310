/* What the start-up code promises: initialised data, a clock that counts instructions, a serial line, and an exit
 * status of 3 for any fault.  Each byte that comes is a test. */
#include "target.h"

static volatile double initialised = 2.0;
static volatile float zeroed[3];

int main(void)
{
    for (;;) {
        const int received = target_read();
        unsigned char answer = (unsigned char)(received + 1);
        if (received == 'c') { /* a million turns of two instructions: 50000 ticks of 40 */
            uint32_t turns = 1000000U, ticks = target_ticks();
            __asm__ volatile("1: subs %0, %0, #1\n bne 1b" : "+r"(turns) : : "cc");
            ticks = target_ticks() - ticks;
            target_print(ticks >= 49999U && ticks <= 50001U ? "as many ticks\n" : "other ticks\n");
        } else if (received == 'f') { /* memory that is not there */
            *(volatile uint32_t *)0xF0000000U = 1U;
        } else if (received == 'n') { /* no FPU */
            *(volatile uint32_t *)0xE000ED88U = 0U;
            __asm__ volatile("dsb\n\tisb" ::: "memory");
            zeroed[0] += 1.0F;
        } else if (received == 'q') {
            initialised *= 2.0;
            zeroed[0] += 1.0F;
            return initialised >= 4.0 && initialised <= 4.0 && zeroed[0] + zeroed[1] <= 1.0F ? 0 : 7;
        } else if (received >= 0) {
            target_write(&answer, 1);
        }
    }
}
