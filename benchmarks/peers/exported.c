/* Exported functions of (q, v, tau), timed in C: seconds for one call, as the mean over `calls` samples in turn; and a loop at
   1 kHz, with how late it wakes and how long each call takes. */

#define _GNU_SOURCE
#include <sched.h>
#include <sys/mman.h>
#include <time.h>

typedef int (*Function)(const double *, const double *, const double *, double *);
typedef int (*Jacobian)(const double *, const double *, const double *, double *, double *, double *);

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}

double time_function(Function f, long nq, long nv, long calls, long samples, const double *q, const double *v,
                     const double *tau, double *a) {
    double start = now();
    for (long k = 0; k < calls; k++) {
        long s = k % samples;
        f(q + s * nq, v + s * nv, tau + s * nv, a);
    }
    return (now() - start) / calls;
}

double time_jacobian(Jacobian f, long nq, long nv, long calls, long samples, const double *q, const double *v,
                     const double *tau, double *by_q, double *by_v, double *by_tau) {
    double start = now();
    for (long k = 0; k < calls; k++) {
        long s = k % samples;
        f(q + s * nq, v + s * nv, tau + s * nv, by_q, by_v, by_tau);
    }
    return (now() - start) / calls;
}

/* For `count` periods of a millisecond: seconds by which the loop woke late, and seconds of one call. Returns 1 where the
   kernel allowed real-time scheduling, else 0. */
int run_loop(Function f, long nq, long nv, long count, long samples, const double *q, const double *v, const double *tau,
             double *a, double *late, double *busy) {
    struct sched_param priority = {.sched_priority = 80};
    int is_real_time = sched_setscheduler(0, SCHED_FIFO, &priority) == 0;
    mlockall(MCL_CURRENT | MCL_FUTURE);
    struct timespec next;
    clock_gettime(CLOCK_MONOTONIC, &next);
    for (long k = 0; k < count; k++) {
        next.tv_nsec += 1000000;
        if (next.tv_nsec >= 1000000000) next.tv_nsec -= 1000000000, next.tv_sec++;
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &next, 0);
        double start = now();
        long s = k % samples;
        f(q + s * nq, v + s * nv, tau + s * nv, a);
        busy[k] = now() - start;
        late[k] = start - (next.tv_sec + 1e-9 * next.tv_nsec);
    }
    priority.sched_priority = 0;
    sched_setscheduler(0, SCHED_OTHER, &priority);
    munlockall();
    return is_real_time;
}
