/* A Cortex-M4F or M7 on a board of Arm's MPS2, as QEMU emulates it, from reset on.  What is the board's and not the
 * processor's: the UART, and its clock of 25 MHz. */
#include "target.h"

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define CPACR REGISTER(0xE000ED88U)        /* access to the FPU */
#define SYST_CONTROL REGISTER(0xE000E010U) /* SysTick, counting down from 2^24 - 1 */
#define SYST_RELOAD REGISTER(0xE000E014U)
#define SYST_VALUE REGISTER(0xE000E018U)
#define UART_DATA REGISTER(0x40004000U)
#define UART_STATE REGISTER(0x40004004U) /* bit 0: cannot send; bit 1: a byte has come */
#define UART_CONTROL REGISTER(0x40004008U)
#define UART_DIVIDER REGISTER(0x40004010U)
#define TICKS 0xFFFFFFU
#define FAULT 3U /* exit status of whatever is not expected */

extern uint32_t stack_top[], data_start[], data_end[], data_source[], bss_start[], bss_end[]; /* mps2.ld */
int main(void);
void reset(void);
void fault(void);

const uint32_t target_ticks_per_ms = 25000U;

/* A request to the debugger or emulator.  SYS_EXIT_EXTENDED takes the address of its reason and status. */
static void semihosting(uint32_t operation, const void *argument)
{
    register uint32_t r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
}

static void leave(uint32_t status)
{
    const uint32_t reason[2] = {0x20026U /* ADP_Stopped_ApplicationExit */, status};
    for (;;) {
        semihosting(0x20U /* SYS_EXIT_EXTENDED */, reason);
    }
}

void fault(void)
{
    leave(FAULT);
}

void reset(void)
{
    const uint32_t *from = data_source;
    CPACR |= 0xFU << 20; /* else the first instruction of the FPU faults */
    __asm__ volatile("dsb\n\tisb" ::: "memory");
    for (uint32_t *to = data_start; to != data_end; to++, from++) {
        *to = *from;
    }
    for (uint32_t *to = bss_start; to != bss_end; to++) {
        *to = 0;
    }
    SYST_RELOAD = TICKS;
    SYST_VALUE = 0;
    SYST_CONTROL = 5U; /* on, by the processor's clock, without interrupts */
    UART_DIVIDER = 16U;
    UART_CONTROL = 3U; /* sends and receives */
    leave((uint32_t)main());
}

struct vectors {
    uint32_t *stack;
    void (*handlers[15])(void);
};

extern const struct vectors vectors;
__attribute__((section(".vectors"))) const struct vectors vectors = {
    stack_top, {reset, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault}};

uint32_t target_ticks(void)
{
    static uint32_t ticks, before = TICKS;
    const uint32_t now = SYST_VALUE;
    ticks += (before - now) & TICKS;
    before = now;
    return ticks;
}

void target_print(const char *text)
{
    semihosting(0x04U /* SYS_WRITE0 */, text);
}

int target_read(void)
{
    return (UART_STATE & 2U) != 0U ? (int)(UART_DATA & 0xFFU) : -1;
}

void target_write(const void *bytes, size_t count)
{
    const unsigned char *next = bytes;
    for (; count > 0; count--, next++) {
        while ((UART_STATE & 1U) != 0U) {
        }
        UART_DATA = *next;
    }
}
