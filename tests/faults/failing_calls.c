/* Preloaded library (ld.so(8), LD_PRELOAD) that spoils one file operation of a process, on files below a folder.
 *
 * spoil(folder, nth, how): the nth call from now on fails with the error number `how`; SHORT transfers half as much
 * where the call transfers bytes, else fails with EINTR; CUT ends the process at once, as a power cut does.
 * calls(): how many there were. With `trace` a descriptor, each write, sync and rename is a line in it. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

enum { SHORT = -1, CUT = -2 };
static char folder[4096];
static int nth, how, count, tracing = -1;

void spoil(const char *below, int call, int what, int trace) {
    snprintf(folder, sizeof folder, "%s", below);
    nth = call; how = what; count = 0; tracing = trace;
}
int calls(void) { return count; }

static int ours(const char *path) { return folder[0] && path && !strncmp(path, folder, strlen(folder)); }
static const char *named(int fd) {
    static __thread char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(link, path, sizeof path - 1);
    path[n > 0 ? n : 0] = 0;
    return path;
}
static void note(const char *what, const char *path, const char *to) {
    static __thread char line[9000];
    if (tracing < 0) return;
    ssize_t (*real)(int, const void *, size_t) = dlsym(RTLD_NEXT, "write");
    int n = snprintf(line, sizeof line, "%s\t%s\t%s\n", what, path, to);
    if (real(tracing, line, n) != n) _exit(98);
}
/* Whether this call is spoilt: 0 no, 1 it fails with errno set, 2 it is short. */
static int spoilt(int is_ours) {
    if (!is_ours || ++count != nth) return 0;
    if (how == CUT) _exit(99);
    if (how == SHORT) { errno = EINTR; return 2; }
    errno = how;
    return 1;
}
#define REAL(type, name, ...) type (*real)(__VA_ARGS__) = dlsym(RTLD_NEXT, name)
#define PATH1(type, name, bad, args, pass, ...) \
    type name args { REAL(type, #name, __VA_ARGS__); if (spoilt(ours(path))) return bad; return real pass; }
#define HANDLE(type, name, args, pass, ...) \
    type name args { REAL(type, #name, __VA_ARGS__); if (spoilt(ours(named(fd)))) return -1; return real pass; }
#define MOVES(name, writes, args, full, half, ...) \
    ssize_t name args { REAL(ssize_t, #name, __VA_ARGS__); int is = ours(named(fd)), s = spoilt(is); \
        if (s == 1) return -1; if (is && writes) note("write", named(fd), ""); \
        return s == 2 && n > 1 ? real half : real full; }
#define OPENS(name) \
    int name(const char *path, int flags, ...) { REAL(int, #name, const char *, int, ...); va_list more; \
        va_start(more, flags); int mode = va_arg(more, int); va_end(more); \
        if (spoilt(ours(path))) return -1; return real(path, flags, mode); }
OPENS(open)
OPENS(open64)
MOVES(read, 0, (int fd, void *to, size_t n), (fd, to, n), (fd, to, n / 2), int, void *, size_t)
MOVES(write, 1, (int fd, const void *at, size_t n), (fd, at, n), (fd, at, n / 2), int, const void *, size_t)
MOVES(pwrite64, 1, (int fd, const void *at, size_t n, off64_t o), (fd, at, n, o), (fd, at, n / 2, o), int, const void *, size_t, off64_t)
MOVES(pwrite, 1, (int fd, const void *at, size_t n, off_t o), (fd, at, n, o), (fd, at, n / 2, o), int, const void *, size_t, off_t)
HANDLE(int, flock, (int fd, int kind), (fd, kind), int, int)
HANDLE(int, fstat, (int fd, struct stat *to), (fd, to), int, struct stat *)
HANDLE(int, fstat64, (int fd, struct stat64 *to), (fd, to), int, struct stat64 *)
PATH1(int, stat, -1, (const char *path, struct stat *to), (path, to), const char *, struct stat *)
PATH1(int, stat64, -1, (const char *path, struct stat64 *to), (path, to), const char *, struct stat64 *)
PATH1(int, lstat, -1, (const char *path, struct stat *to), (path, to), const char *, struct stat *)
PATH1(int, lstat64, -1, (const char *path, struct stat64 *to), (path, to), const char *, struct stat64 *)
PATH1(int, mkdir, -1, (const char *path, mode_t mode), (path, mode), const char *, mode_t)
PATH1(int, access, -1, (const char *path, int mode), (path, mode), const char *, int)
PATH1(void *, opendir, NULL, (const char *path), (path), const char *)
PATH1(int, unlink, -1, (const char *path), (path), const char *)
int fsync(int fd) {
    REAL(int, "fsync", int);
    if (spoilt(ours(named(fd)))) return -1;
    note("sync", named(fd), "");
    return real(fd);
}
int fdatasync(int fd) {
    REAL(int, "fdatasync", int);
    if (spoilt(ours(named(fd)))) return -1;
    note("sync", named(fd), "");
    return real(fd);
}
int rename(const char *path, const char *to) {
    REAL(int, "rename", const char *, const char *);
    if (spoilt(ours(path))) return -1;
    note("rename", path, to);
    return real(path, to);
}
