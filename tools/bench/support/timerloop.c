/* Two small programs for the benchmark of latency, in one file.

   timerloop wait PERIOD_US COUNT PRIORITY   a bare loop on timerfd: prints by how many us each turn was late
   timerloop burn                            walks through 64 MB for ever: another program that keeps a core busy */

#define _GNU_SOURCE
#include <sched.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

static int64_t now_ns(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static int burn(void) {
    size_t size = 64 << 20;
    volatile unsigned char *memory = malloc(size);
    if (!memory || prctl(PR_SET_PDEATHSIG, SIGKILL)) return 1; /* whoever measures may be killed */
    for (unsigned round = 0;; round++)
        for (size_t at = 0; at < size; at += 64) memory[at] += (unsigned char)round;
}

static int wait_loop(int64_t period_ns, long count, int priority) {
    if (priority > 0) {
        struct sched_param wanted = {.sched_priority = priority};
        if (sched_setscheduler(0, SCHED_FIFO, &wanted)) { perror("sched_setscheduler"); return 2; }
        mlockall(MCL_CURRENT | MCL_FUTURE);
    }
    double *late = calloc((size_t)count, sizeof *late);
    int timer = timerfd_create(CLOCK_MONOTONIC, 0);
    if (!late || timer < 0) return 1;
    int64_t due = now_ns() + period_ns;
    for (long turn = 0; turn < count; turn++, due += period_ns) {
        struct itimerspec when = {{0, 0}, {due / 1000000000, due % 1000000000}};
        uint64_t times;
        timerfd_settime(timer, TFD_TIMER_ABSTIME, &when, NULL);
        if (read(timer, &times, sizeof times) != sizeof times) return 1;
        late[turn] = (double)(now_ns() - due) / 1000.0;
    }
    for (long turn = 0; turn < count; turn++) printf("%.1f\n", late[turn]);
    return 0;
}

int main(int count, char **words) {
    if (count == 2 && !strcmp(words[1], "burn")) return burn();
    if (count == 5 && !strcmp(words[1], "wait"))
        return wait_loop(atoll(words[2]) * 1000, atol(words[3]), atoi(words[4]));
    fprintf(stderr, "usage: timerloop wait PERIOD_US COUNT PRIORITY | timerloop burn\n");
    return 2;
}
