/* Preloaded: the system clock of a process reads as many seconds more as its file says.
 * The file is FOGFT_CLOCKS/PID, or FOGFT_CLOCKS if that is a file: 8 bytes. Clocks that only
 * count on, CLOCK_MONOTONIC, stay.
 * A wait until a time of the system clock ends by the clock that was set, also if it is set
 * meanwhile: so C++ for glibc before 2.30 waits, and with it Fast DDS of the wheels. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static volatile long *offset_s;

__attribute__((constructor)) static void begin(void) {
    char path[4096];
    const char *folder = getenv("FOGFT_CLOCKS");
    if (!folder) return;
    snprintf(path, sizeof path, "%s/%d", folder, getpid());
    int file = open(folder, O_RDWR | O_CLOEXEC);
    if (file < 0) file = open(path, O_RDWR | O_CREAT | O_CLOEXEC, 0600);
    if (file < 0 || ftruncate(file, sizeof(long))) return;
    void *mapped = mmap(NULL, sizeof(long), PROT_READ, MAP_SHARED, file, 0);
    close(file);
    if (mapped != MAP_FAILED) offset_s = mapped;
}

int clock_gettime(clockid_t clock, struct timespec *at) {
    int failed = syscall(SYS_clock_gettime, clock, at);
    if (!failed && offset_s && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE))
        at->tv_sec += *offset_s;
    return failed;
}

time_t time(time_t *told) {
    struct timespec at;
    clock_gettime(CLOCK_REALTIME, &at);
    if (told) *told = at.tv_sec;
    return at.tv_sec;
}

int gettimeofday(struct timeval *restrict at, void *restrict zone) {
    struct timespec now;
    (void)zone;
    clock_gettime(CLOCK_REALTIME, &now);
    at->tv_sec = now.tv_sec;
    at->tv_usec = now.tv_nsec / 1000;
    return 0;
}

#define WAITS_BY_MONOTONIC 2 /* of glibc's pthread_cond_t.__data.__wrefs */
#define LOOK_EVERY_NS 50000000L

static int reached(const struct timespec *at, const struct timespec *now) {
    return now->tv_sec > at->tv_sec || (now->tv_sec == at->tv_sec && now->tv_nsec >= at->tv_nsec);
}

/* Say until when of the real clock to wait next; whether that is the end of the whole wait. */
static int next_look(const struct timespec *until, long ahead_s, struct timespec *look) {
    struct timespec end = *until;
    end.tv_sec -= ahead_s;
    syscall(SYS_clock_gettime, CLOCK_REALTIME, look);
    look->tv_nsec += LOOK_EVERY_NS;
    if (look->tv_nsec >= 1000000000L) look->tv_sec++, look->tv_nsec -= 1000000000L;
    if (!reached(&end, look)) return 0;
    *look = end;
    return 1;
}

static void *original(const char *name, const char *version) {
    void *found = dlvsym(RTLD_NEXT, name, version);
    return found ? found : dlsym(RTLD_NEXT, name);
}

int pthread_cond_timedwait(pthread_cond_t *restrict condition, pthread_mutex_t *restrict mutex,
                           const struct timespec *restrict until) {
    static int (*wait)(pthread_cond_t *, pthread_mutex_t *, const struct timespec *);
    if (!wait) wait = original("pthread_cond_timedwait", "GLIBC_2.3.2");
    if (!offset_s || condition->__data.__wrefs & WAITS_BY_MONOTONIC)
        return wait(condition, mutex, until);
    for (;;) {
        struct timespec look;
        int is_last = next_look(until, *offset_s, &look);
        int failed = wait(condition, mutex, &look);
        if (failed != ETIMEDOUT || is_last) return failed;
    }
}

/* Fast DDS listens so at its shared memory, whatever it was built for. */
int sem_timedwait(sem_t *restrict semaphore, const struct timespec *restrict until) {
    static int (*wait)(sem_t *, const struct timespec *);
    if (!wait) wait = original("sem_timedwait", "GLIBC_2.2.5");
    if (!offset_s) return wait(semaphore, until);
    for (;;) {
        struct timespec look;
        int is_last = next_look(until, *offset_s, &look);
        if (!wait(semaphore, &look)) return 0;
        if (errno != ETIMEDOUT || is_last) return -1;
    }
}
