/* A coded ceiling lamp for lumiloop, from docs/air-interface.md alone. C99; no floating point, no heap.
 *
 * In a lamp: compile with -DLAMP_EMBEDDED, call lamp_init() once and lamp_next() every half chip from a timer (100 us
 * in profile A, crystal 50 ppm or better); 1 is mean (1 + depth), 0 is mean (1 - depth) of the light.
 *
 * On a computer, to look at what it sends:
 *     cc -O2 -o transmitter transmitter.c
 *     ./transmitter CODE LAMP X_MM Y_MM Z_MM POWER_MW HALF_ANGLE_DEG HALF_CHIPS */
#include <stdint.h>

#ifndef DEGREE
#define DEGREE 7 /* profile A; 6 is profile B, 9 is profile D */
#endif

#if DEGREE == 6
#define FEEDBACK_U 0x43 /* x^6 + x + 1 */
#define FEEDBACK_V 0x67 /* x^6 + x^5 + x^2 + x + 1 */
#elif DEGREE == 7
#define FEEDBACK_U 0x89 /* x^7 + x^3 + 1 */
#define FEEDBACK_V 0x8F /* x^7 + x^3 + x^2 + x + 1 */
#elif DEGREE == 9
#define FEEDBACK_U 0x211 /* x^9 + x^4 + 1 */
#define FEEDBACK_V 0x259 /* x^9 + x^6 + x^4 + x^3 + 1 */
#else
#error "DEGREE is 6, 7 or 9"
#endif

enum { LENGTH = (1 << DEGREE) - 1, CODES = LENGTH + 2, FRAME_BITS = 116, STEP_MM = 5, STEP_MW = 10 };

struct lamp_data { /* what the lamp says about itself */
    uint16_t lamp;
    int32_t x_mm, y_mm, z_mm, power_mw;
    uint8_t half_angle_deg; /* 0: not told */
};

struct lamp {
    uint8_t chips[(LENGTH + 7) / 8], frame[(FRAME_BITS + 7) / 8];
    uint16_t chip;
    uint8_t bit, half;
};

static int get_bit(const uint8_t *bits, unsigned at) { return bits[at / 8] >> (7 - at % 8) & 1; }

static void put_bit(uint8_t *bits, unsigned at, int value) {
    uint8_t mask = (uint8_t)(0x80 >> at % 8);
    bits[at / 8] = (uint8_t)(value ? bits[at / 8] | mask : bits[at / 8] & ~mask);
}

/* A shift register sequence, begun in the one phase in which s(2t) = s(t). */
static void sequence(uint8_t *bits, unsigned feedback) {
    uint8_t raw[(LENGTH + 7) / 8] = {0};
    unsigned state = 1, start, t;
    for (t = 0; t < LENGTH; t++) {
        unsigned taps = state & feedback, sum = 0;
        put_bit(raw, t, (int)(state & 1));
        for (; taps; taps >>= 1) sum ^= taps & 1;
        state = state >> 1 | sum << (DEGREE - 1);
    }
    for (start = 0; start < LENGTH; start++) {
        for (t = 0; t < LENGTH; t++)
            if (get_bit(raw, (start + 2 * t) % LENGTH) != get_bit(raw, (start + t) % LENGTH)) break;
        if (t == LENGTH) break;
    }
    for (t = 0; t < LENGTH; t++) put_bit(bits, t, get_bit(raw, (start + t) % LENGTH));
}

static uint16_t crc_step(uint16_t crc, int bit) { /* CRC-16/CCITT-FALSE, one bit */
    int carry = (crc >> 15 ^ bit) & 1;
    return (uint16_t)((crc << 1) ^ (carry ? 0x1021 : 0));
}

static unsigned put_field(uint8_t *frame, unsigned at, uint32_t value, unsigned width) {
    while (width--) put_bit(frame, at++, (int)(value >> width & 1));
    return at;
}

/* To the nearest step; 0 if that does not fit. */
static int to_steps(int32_t value, int32_t step, int32_t low, int32_t high, uint32_t *steps) {
    int32_t nearest;
    if (value < INT32_MIN + step || value > INT32_MAX - step) return 0;
    nearest = (value + (value < 0 ? -(step / 2) : step / 2)) / step;
    *steps = (uint32_t)nearest;
    return nearest >= low && nearest <= high;
}

/* 0, or -1 if the code does not exist or a value does not fit its field. */
int lamp_init(struct lamp *lamp, uint16_t code, const struct lamp_data *data) {
    uint8_t u[sizeof lamp->chips] = {0}, v[sizeof lamp->chips] = {0};
    uint32_t x = 0, y = 0, z = 0, power = 0;
    uint16_t crc = 0xFFFF;
    unsigned at = 0, t;
    if (code >= CODES || data->half_angle_deg > 127) return -1;
    if (!to_steps(data->x_mm, STEP_MM, -131072, 131071, &x) || !to_steps(data->y_mm, STEP_MM, -131072, 131071, &y) ||
        !to_steps(data->z_mm, STEP_MM, 0, 4095, &z) || !to_steps(data->power_mw, STEP_MW, 0, 2047, &power))
        return -1;
    sequence(u, FEEDBACK_U);
    sequence(v, FEEDBACK_V);
    for (t = 0; t < LENGTH; t++) {
        int from_u = code != LENGTH + 1 && get_bit(u, t);
        int from_v = code != LENGTH && get_bit(v, code > LENGTH ? t : (t + code) % LENGTH);
        put_bit(lamp->chips, t, from_u ^ from_v);
    }
    at = put_field(lamp->frame, at, 0xEB90, 16);
    at = put_field(lamp->frame, at, 0, 2); /* version */
    at = put_field(lamp->frame, at, data->lamp, 16);
    at = put_field(lamp->frame, at, x, 18);
    at = put_field(lamp->frame, at, y, 18);
    at = put_field(lamp->frame, at, z, 12);
    at = put_field(lamp->frame, at, power, 11);
    at = put_field(lamp->frame, at, data->half_angle_deg, 7);
    for (t = 16; t--;) crc = crc_step(crc, code >> t & 1); /* the code's number is protected, not sent */
    for (t = 16; t < at; t++) crc = crc_step(crc, get_bit(lamp->frame, t));
    put_field(lamp->frame, at, crc, 16);
    lamp->chip = lamp->bit = lamp->half = 0;
    return 0;
}

/* Level of the half chip that begins now: 1 bright, 0 dark. */
int lamp_next(struct lamp *lamp) {
    int level = 1 ^ lamp->half ^ get_bit(lamp->chips, lamp->chip) ^ get_bit(lamp->frame, lamp->bit);
    lamp->half ^= 1;
    if (!lamp->half && ++lamp->chip == LENGTH) {
        lamp->chip = 0;
        if (++lamp->bit == FRAME_BITS) lamp->bit = 0;
    }
    return level;
}

#ifndef LAMP_EMBEDDED
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>

int main(int argc, char **argv) {
    static const char *const names[] = {"CODE", "LAMP",     "X_MM",           "Y_MM",
                                        "Z_MM", "POWER_MW", "HALF_ANGLE_DEG", "HALF_CHIPS"};
    static const long highest[] = {CODES - 1, 65535, 655355, 655355, 20475, 20470, 127, 100000000};
    long value[8];
    struct lamp lamp;
    struct lamp_data data;
    int k;
    if (argc != 9) {
        fprintf(stderr, "usage: %s CODE LAMP X_MM Y_MM Z_MM POWER_MW HALF_ANGLE_DEG HALF_CHIPS\n", argv[0]);
        return 2;
    }
    for (k = 0; k < 8; k++) {
        char *end;
        long low = k == 2 || k == 3 ? -655360 : 0;
        errno = 0;
        value[k] = strtol(argv[k + 1], &end, 10);
        if (errno || *end || end == argv[k + 1] || value[k] < low || value[k] > highest[k])
            return fprintf(stderr, "%s %s: expected %ld to %ld\n", names[k], argv[k + 1], low, highest[k]), 2;
    }
    data.lamp = (uint16_t)value[1];
    data.x_mm = (int32_t)value[2], data.y_mm = (int32_t)value[3], data.z_mm = (int32_t)value[4];
    data.power_mw = (int32_t)value[5], data.half_angle_deg = (uint8_t)value[6];
    if (lamp_init(&lamp, (uint16_t)value[0], &data)) return fprintf(stderr, "a value does not fit its field\n"), 2;
    while (value[7]--) putchar('0' + lamp_next(&lamp));
    return fflush(stdout) ? 1 : 0;
}
#endif
