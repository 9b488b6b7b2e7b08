/* Records what a process writes below one folder, for LD_PRELOAD: writes with their data, names, and what was synced.

   DURABILITY_ROOT: the folder, an absolute path. DURABILITY_TRACE: the file to append to, outside of it.
   A record: kind (1 byte), inode (8), offset (8), lengths of two texts (4, 4), the texts. See disk.py. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

static pthread_mutex_t order = PTHREAD_MUTEX_INITIALIZER;

static const char *root(void) { return getenv("DURABILITY_ROOT"); }

static void raw_write(int fd, const void *data, size_t size)
{
    const char *at = data;
    while (size) {
        long done = syscall(SYS_write, fd, at, size);
        if (done <= 0) abort();
        at += done;
        size -= (size_t)done;
    }
}

static void put(char kind, uint64_t inode, uint64_t offset, const void *a, size_t a_size, const void *b, size_t b_size)
{
    static int trace = -1;
    if (trace < 0) {
        const char *name = getenv("DURABILITY_TRACE");
        if (!name) return;
        trace = (int)syscall(SYS_openat, AT_FDCWD, name, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
        if (trace < 0) abort();
    }
    unsigned char head[25];
    uint32_t sizes[2] = {(uint32_t)a_size, (uint32_t)b_size};
    head[0] = (unsigned char)kind;
    memcpy(head + 1, &inode, 8);
    memcpy(head + 9, &offset, 8);
    memcpy(head + 17, sizes, 8);
    raw_write(trace, head, sizeof head);
    raw_write(trace, a, a_size);
    raw_write(trace, b, b_size);
}

/* The absolute path of a name, or NULL if it is not below the folder. */
static const char *place(int dir, const char *name, char *out)
{
    const char *top = root();
    if (!top || !name) return NULL;
    if (name[0] == '/') {
        snprintf(out, PATH_MAX, "%s", name);
    } else if (dir == AT_FDCWD) {
        char here[PATH_MAX / 2];
        if (!getcwd(here, sizeof here)) return NULL;
        snprintf(out, PATH_MAX, "%.2000s/%.2000s", here, name);
    } else {
        char link[64], folder[PATH_MAX / 2];
        snprintf(link, sizeof link, "/proc/self/fd/%d", dir);
        ssize_t size = readlink(link, folder, sizeof folder - 1);
        if (size < 0) return NULL;
        folder[size] = 0;
        snprintf(out, PATH_MAX, "%.2000s/%.2000s", folder, name);
    }
    return strncmp(out, top, strlen(top)) == 0 ? out : NULL;
}

/* Whether a descriptor is of something below the folder. */
static int inside(int fd, struct stat *status, char *path)
{
    const char *top = root();
    char link[64];
    if (!top || fstat(fd, status)) return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t size = readlink(link, path, PATH_MAX - 1);
    if (size < 0) return 0;
    path[size] = 0;
    return strncmp(path, top, strlen(top)) == 0;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define KEEPING(call)                   \
    do {                                \
        int kept = errno;               \
        call;                           \
        errno = kept;                   \
    } while (0)

static int opened(int dir, const char *name, int flags, mode_t mode)
{
    char path[PATH_MAX];
    const char *where = (flags & (O_CREAT | O_TRUNC)) ? place(dir, name, path) : NULL;
    pthread_mutex_lock(&order);
    int fd = (int)syscall(SYS_openat, dir, name, flags, mode);
    struct stat status;
    if (fd >= 0 && where && !fstat(fd, &status) && S_ISREG(status.st_mode))
        KEEPING(put('O', status.st_ino, (flags & O_TRUNC) != 0, where, strlen(where), "", 0));
    pthread_mutex_unlock(&order);
    return fd;
}

#define MODE()                                      \
    mode_t mode = 0;                                \
    if (flags & (O_CREAT | __O_TMPFILE)) {          \
        va_list more;                               \
        va_start(more, flags);                      \
        mode = va_arg(more, mode_t);                \
        va_end(more);                               \
    }

int open(const char *name, int flags, ...) { MODE() return opened(AT_FDCWD, name, flags, mode); }
int open64(const char *name, int flags, ...) { MODE() return opened(AT_FDCWD, name, flags, mode); }
int openat(int dir, const char *name, int flags, ...) { MODE() return opened(dir, name, flags, mode); }
int openat64(int dir, const char *name, int flags, ...) { MODE() return opened(dir, name, flags, mode); }
int creat(const char *name, mode_t mode) { return opened(AT_FDCWD, name, O_CREAT | O_WRONLY | O_TRUNC, mode); }

static void wrote(int fd, off_t at, const void *data, ssize_t size)
{
    char path[PATH_MAX];
    struct stat status;
    if (size > 0 && inside(fd, &status, path) && S_ISREG(status.st_mode))
        put('W', status.st_ino, (uint64_t)at, "", 0, data, (size_t)size);
}

ssize_t write(int fd, const void *data, size_t size)
{
    pthread_mutex_lock(&order);
    ssize_t done = syscall(SYS_write, fd, data, size);
    if (done > 0 && root()) KEEPING({
        off_t end = (off_t)syscall(SYS_lseek, fd, 0, SEEK_CUR);
        if (end >= 0) wrote(fd, end - done, data, done);
    });
    pthread_mutex_unlock(&order);
    return done;
}

ssize_t writev(int fd, const struct iovec *parts, int count)
{
    ssize_t sum = 0;
    for (int i = 0; i < count; i++) {
        ssize_t done = write(fd, parts[i].iov_base, parts[i].iov_len);
        if (done < 0) return sum ? sum : done;
        sum += done;
        if ((size_t)done < parts[i].iov_len) break;
    }
    return sum;
}

ssize_t pwrite64(int fd, const void *data, size_t size, off_t at)
{
    pthread_mutex_lock(&order);
    ssize_t done = syscall(SYS_pwrite64, fd, data, size, at);
    KEEPING(wrote(fd, at, data, done));
    pthread_mutex_unlock(&order);
    return done;
}
ssize_t pwrite(int fd, const void *data, size_t size, off_t at) { return pwrite64(fd, data, size, at); }

/* Copies by the kernel are refused: callers fall back on write. */
ssize_t sendfile64(int out, int in, off_t *at, size_t size) { (void)out, (void)in, (void)at, (void)size; errno = EINVAL; return -1; }
ssize_t sendfile(int out, int in, off_t *at, size_t size) { return sendfile64(out, in, at, size); }
ssize_t copy_file_range(int in, off_t *from, int out, off_t *to, size_t size, unsigned flags)
{
    (void)in, (void)from, (void)out, (void)to, (void)size, (void)flags;
    errno = EXDEV;
    return -1;
}

int ftruncate64(int fd, off_t size)
{
    char path[PATH_MAX];
    struct stat status;
    pthread_mutex_lock(&order);
    int done = (int)syscall(SYS_ftruncate, fd, size);
    if (!done && inside(fd, &status, path)) KEEPING(put('T', status.st_ino, (uint64_t)size, "", 0, "", 0));
    pthread_mutex_unlock(&order);
    return done;
}
int ftruncate(int fd, off_t size) { return ftruncate64(fd, size); }

static int synced(int fd, long number)
{
    char path[PATH_MAX];
    struct stat status;
    pthread_mutex_lock(&order);
    int done = (int)syscall(number, fd);
    if (!done && inside(fd, &status, path))
        KEEPING(put(S_ISDIR(status.st_mode) ? 'D' : 'S', status.st_ino, 0, path, strlen(path), "", 0));
    pthread_mutex_unlock(&order);
    return done;
}
int fsync(int fd) { return synced(fd, SYS_fsync); }
int fdatasync(int fd) { return synced(fd, SYS_fdatasync); }

/* Changes of names: kind, the call, and one or two places. */
#define NAMED(kind, call, a_dir, a, b_dir, b)                                                      \
    char one[PATH_MAX], two[PATH_MAX];                                                             \
    const char *first = place(a_dir, a, one), *second = place(b_dir, b, two);                      \
    pthread_mutex_lock(&order);                                                                    \
    int done = (int)(call);                                                                        \
    if (!done && (first || second))                                                                \
        KEEPING(put(kind, 0, 0, first ? first : "", first ? strlen(first) : 0,                     \
                    second ? second : "", second ? strlen(second) : 0));                           \
    pthread_mutex_unlock(&order);                                                                  \
    return done;

int renameat2(int a_dir, const char *a, int b_dir, const char *b, unsigned flags)
{
    NAMED((flags & 2) ? 'E' : 'R', syscall(SYS_renameat2, a_dir, a, b_dir, b, flags), a_dir, a, b_dir, b)
}
int renameat(int a_dir, const char *a, int b_dir, const char *b) { return renameat2(a_dir, a, b_dir, b, 0); }
int rename(const char *a, const char *b) { return renameat2(AT_FDCWD, a, AT_FDCWD, b, 0); }
int linkat(int a_dir, const char *a, int b_dir, const char *b, int flags)
{
    NAMED('L', syscall(SYS_linkat, a_dir, a, b_dir, b, flags), a_dir, a, b_dir, b)
}
int link(const char *a, const char *b) { return linkat(AT_FDCWD, a, AT_FDCWD, b, 0); }
int unlinkat(int dir, const char *name, int flags)
{
    NAMED((flags & AT_REMOVEDIR) ? 'X' : 'U', syscall(SYS_unlinkat, dir, name, flags), dir, name, AT_FDCWD, NULL)
}
int unlink(const char *name) { return unlinkat(AT_FDCWD, name, 0); }
int rmdir(const char *name) { return unlinkat(AT_FDCWD, name, AT_REMOVEDIR); }
int mkdirat(int dir, const char *name, mode_t mode)
{
    NAMED('M', syscall(SYS_mkdirat, dir, name, mode), dir, name, AT_FDCWD, NULL)
}
int mkdir(const char *name, mode_t mode) { return mkdirat(AT_FDCWD, name, mode); }
int symlinkat(const char *target, int dir, const char *name)
{
    char path[PATH_MAX];
    const char *where = place(dir, name, path);
    pthread_mutex_lock(&order);
    int done = (int)syscall(SYS_symlinkat, target, dir, name);
    if (!done && where) KEEPING(put('Y', 0, 0, target, strlen(target), where, strlen(where)));
    pthread_mutex_unlock(&order);
    return done;
}
int symlink(const char *target, const char *name) { return symlinkat(target, AT_FDCWD, name); }
