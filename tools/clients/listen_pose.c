/* Listen for lumiloop's pose datagrams and print each as one line; any C99 compiler on a POSIX system.
 *
 *     cc -O2 -o listen_pose listen_pose.c && ./listen_pose PORT [COUNT]
 *
 * Written from docs/udp.md alone. Bytes are put together by hand, so that it runs on any byte order. */
#include <arpa/inet.h>
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>

enum { SMALLEST = 132, WITH_BOUND = 172, LARGEST = 512 };

static uint32_t u32(const uint8_t *p) {
    return p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24;
}

static uint16_t u16(const uint8_t *p) { return (uint16_t)(p[0] | p[1] << 8); }

static uint64_t u64(const uint8_t *p) { return u32(p) | (uint64_t)u32(p + 4) << 32; }

static int32_t i32(const uint8_t *p) {
    uint32_t u = u32(p);
    return u < 0x80000000u ? (int32_t)u : -(int32_t)(0xFFFFFFFFu - u) - 1;
}

static uint32_t crc32(const uint8_t *data, size_t size) { /* IEEE 802.3, as in zlib */
    uint32_t crc = 0xFFFFFFFFu;
    for (size_t i = 0; i < size; i++) {
        crc ^= data[i];
        for (int bit = 0; bit < 8; bit++) crc = crc >> 1 ^ (crc & 1 ? 0xEDB88320u : 0);
    }
    return ~crc;
}

/* What is wrong with a datagram, or NULL. */
static const char *fault(const uint8_t *d, size_t size) {
    if (size < SMALLEST || memcmp(d, "LUMI", 4) != 0) return "not a pose datagram";
    if (u16(d + 4) != 1) return "another version";
    if (u16(d + 6) != size) return "wrong length";
    if (u32(d + size - 4) != crc32(d, size - 4)) return "damaged";
    return NULL;
}

static void show(const uint8_t *d, size_t size) {
    static const char *const states[] = {"STARTING", "NO_LIDAR",  "MAPPING", "TRACKING",
                                         "DEGRADED", "AMBIGUOUS", "LOST",    "RELOCATING"};
    uint16_t state = u16(d + 12);
    printf("seq %" PRIu32 " t_mono %.6f %s", u32(d + 8), u64(d + 24) / 1e6, state < 8 ? states[state] : "UNKNOWN");
    if (i32(d + 40) == INT32_MIN) {
        printf(" no pose\n");
        return;
    }
    printf(" x %.4f y %.4f yaw %.6f age %.4f sigma %.4f %.4f %.4f", i32(d + 40) / 1e4, i32(d + 44) / 1e4,
           i32(d + 48) / 1e6, u16(d + 22) / 1e4, u16(d + 76) / 1e4, u16(d + 78) / 1e4, u16(d + 80) / 1e4);
    if (size >= WITH_BOUND && u16(d + 152) != 0xFFFF) printf(" bound %.3f", u16(d + 152) / 1e3);
    printf("%s\n", u16(d + 18) >> 7 & 1 ? " ALERT" : "");
}

int main(int argc, char **argv) {
    long port = argc > 1 ? strtol(argv[1], NULL, 10) : 0;
    long left = argc > 2 ? strtol(argv[2], NULL, 10) : -1;
    struct sockaddr_in here = {.sin_family = AF_INET, .sin_port = htons((uint16_t)port)};
    int sock = socket(AF_INET, SOCK_DGRAM, 0);
    if (port < 1 || port > 65535) {
        fprintf(stderr, "usage: listen_pose PORT [COUNT]\n");
        return 2;
    }
    if (sock < 0 || bind(sock, (struct sockaddr *)&here, sizeof here) != 0) {
        perror("listen_pose");
        return 1;
    }
    for (uint8_t data[LARGEST]; left != 0; left -= left > 0) {
        ssize_t size = recv(sock, data, sizeof data, 0);
        const char *wrong = size < 0 ? "cannot receive" : fault(data, (size_t)size);
        if (wrong) fprintf(stderr, "dropped: %s\n", wrong);
        else show(data, (size_t)size);
        fflush(stdout);
    }
    return 0;
}
