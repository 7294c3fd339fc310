/* The controller behind a serial line: a question with state and reference comes, an answer with the command goes.
 *
 * Each is one struct, as it lies in memory, that ends with the CRC-32 of all before.  What is corrupt, cut short or old
 * is dropped; a question that comes twice is solved once and answered twice; a row of the reference that was lost is
 * replaced by the next.  Where no fresh state has come for 100 ms the last command is sent again, with the status
 * QUADSIM_MISSED, and so each 100 ms until one comes. */
#include <string.h>

#include "quadsim_data.h"
#include "target.h"

#ifndef WATCHDOG_MS
#define WATCHDOG_MS 100 /* 0 for none */
#endif
#define MARK 0x4D504351U

/* anew, after u(-1) = acting, or after the command of hover where acting is none; a row of the reference alone; all;
 * the same while the ground holds the vehicle */
enum kind { START, ROW, STEP, STAND };

struct question {
    uint32_t mark, number;  /* MARK; one more with each question */
    quadsim_real state[QUADSIM_STATE]; /* x(k), as in the controller's header */
    quadsim_real row[QUADSIM_ROW];     /* the last row of the reference; those before have come before */
    quadsim_real acting[4];            /* u(k - 1) */
    uint32_t kind, crc;
};

struct answer {
    uint32_t mark, number; /* the question's */
    quadsim_real command[4]; /* u(k) */
    uint16_t status, fallback; /* as of quadsim_law_step, and its level */
    uint32_t crc;
};

static quadsim_law law;
static quadsim_memory memory;
static quadsim_real window[QUADSIM_ROW * QUADSIM_ROWS];
static struct answer answer; /* the last one; its mark is 0 before there is one */
static int flying;           /* whether a state has come since the start */

static uint32_t crc32(const void *bytes, size_t count)
{
    const unsigned char *next = bytes;
    uint32_t crc = 0xFFFFFFFFU;
    for (; count > 0; count--) {
        crc ^= *next++;
        for (int bit = 0; bit < 8; bit++) {
            crc = (crc >> 1) ^ ((crc & 1U) != 0U ? 0xEDB88320U : 0U);
        }
    }
    return ~crc;
}

/* Take the next byte, if one has come; 1 where a whole question ends with it. */
static int receive(struct question *question)
{
    static unsigned char bytes[sizeof(struct question)];
    static size_t count;
    const int byte = target_read();
    if (byte < 0) {
        return 0;
    }
    bytes[count++] = (unsigned char)byte;
    if (count < sizeof bytes) {
        return 0;
    }
    memcpy(question, bytes, sizeof bytes);
    if (question->mark == MARK && question->crc == crc32(bytes, offsetof(struct question, crc))) {
        count = 0;
        return 1;
    }
    count--; /* one may begin at any byte */
    memmove(bytes, bytes + 1, count);
    return 0;
}

static void reply(void)
{
    answer.crc = crc32(&answer, offsetof(struct answer, crc));
    target_write(&answer, sizeof answer);
}

/* The command before goes on. */
static void put_missed(void)
{
    answer.status = QUADSIM_MISSED;
    answer.fallback = 1;
}

/* Solve a question, unless it is old; 1 where it is a fresh state. */
static int solve(const struct question *question)
{
    uint32_t rows = question->number - answer.number; /* new ones, those lost included */
    if (question->kind == START) {
        quadsim_law_reset(&law, question->acting);
        memcpy(answer.command, law.guard.before, sizeof answer.command); /* that of hover for what is no command */
        answer.mark = MARK;
        flying = 0;
        rows = QUADSIM_ROWS;
    } else if (answer.mark != MARK || rows == 0U || rows > UINT32_MAX / 2U) {
        return 0;
    }
    for (rows = rows < QUADSIM_ROWS ? rows : QUADSIM_ROWS; rows > 0U; rows--) {
        memmove(window, window + QUADSIM_ROW, sizeof window - sizeof question->row);
        memcpy(window + QUADSIM_ROW * (QUADSIM_ROWS - 1), question->row, sizeof question->row);
    }
    answer.number = question->number;
    put_missed();
    if (question->kind != STEP && question->kind != STAND) {
        return 0;
    }
    flying = 1;
    answer.status = (uint16_t)quadsim_law_step(&law, question->kind == STAND ? QUADSIM_PHASE_ARMED : QUADSIM_PHASE_FLYING,
                                               question->state, window, question->acting, answer.command);
    answer.fallback = (uint16_t)law.guard.level;
    return 1;
}

int main(void)
{
    static struct question question;
    uint32_t fresh = target_ticks();
    quadsim_law_start(&law, &memory);
    for (;;) {
        if (receive(&question)) {
            if (solve(&question)) {
                fresh = target_ticks();
            }
            if (answer.mark == MARK && question.number == answer.number) {
                reply();
            }
        } else if (WATCHDOG_MS > 0 && flying && target_ticks() - fresh > WATCHDOG_MS * target_ticks_per_ms) {
            fresh = target_ticks();
            put_missed();
            reply();
        }
    }
}
