// Stands between a process and libc (LD_PRELOAD), for the files below one folder, the root.
//
// It records what changes files, in the order in which it happened, so that `disk.py` can tell what
// a power cut leaves. And it makes calls fail, so that a test sees what a program does about it.
// Calls outside of the root, and all calls while nothing is armed, pass through untouched.

#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

#define REAL(name)                                             \
  ({                                                           \
    static __typeof__(&name) real;                             \
    if (!real) real = (__typeof__(&name))dlsym(RTLD_NEXT, #name); \
    real;                                                      \
  })

// Kinds of calls; `shim.py` has the same table.
enum {
  OPEN = 1 << 0,
  CREATE = 1 << 1,
  READ = 1 << 2,
  WRITE = 1 << 3,
  SYNC = 1 << 4,
  TRUNCATE = 1 << 5,
  RENAME = 1 << 6,
  LINK = 1 << 7,
  MKDIR = 1 << 8,
  REMOVE = 1 << 9,
  LIST = 1 << 10,
  LOCK = 1 << 11,
  STAT = 1 << 12,
};

enum { PASS, FAIL, SHORT };  // what `strike` says of a call

static struct {
  volatile int armed;
  char root[PATH_MAX];
  size_t length;
  int record, trace;  // file descriptors, -1 for none
  unsigned kinds;     // that fail
  long nth;           // which of them, counted from 1; 0: none
  int error;          // errno; 0: a read or write of half the bytes
  int once;
  long count;
  char fired[PATH_MAX + 64];
} shim = {.record = -1, .trace = -1};
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;

static const char *name_of(int kind) {
  static const char *names[] = {"open", "create", "read",   "write", "fsync", "truncate", "rename",
                                "link", "mkdir",  "remove", "list",  "lock",  "stat"};
  return names[__builtin_ctz(kind)];
}

// --- whose call it is ---

// Makes a path plain: one slash between names, no "." and "..".
static void normalize(char *path) {
  char *to = path, *from = path;
  while (*from) {
    while (*from == '/') from++;
    size_t n = strcspn(from, "/");
    if (n == 2 && from[0] == '.' && from[1] == '.') {
      while (to > path && *--to != '/') continue;
    } else if (n && !(n == 1 && *from == '.')) {
      *to++ = '/';
      memmove(to, from, n);
      to += n;
    }
    from += n;
  }
  *to = 0;
}

static int below_root(const char *path) {
  return !strncmp(path, shim.root, shim.length) && (!path[shim.length] || path[shim.length] == '/');
}

static int fd_ours(int fd, char *path) {
  char link[64];
  if (!shim.armed || fd < 0) return 0;
  snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
  ssize_t n = syscall(SYS_readlink, link, path, PATH_MAX - 1);
  if (n <= 0) return 0;
  path[n] = 0;
  return below_root(path);
}

static int path_ours(int folder, const char *name, char *path) {
  size_t n = 0;
  if (!shim.armed || !name || strlen(name) >= PATH_MAX / 2) return 0;
  if (*name != '/') {
    char link[64];
    if (folder == AT_FDCWD)
      snprintf(link, sizeof link, "/proc/self/cwd");
    else
      snprintf(link, sizeof link, "/proc/self/fd/%d", folder);
    ssize_t got = syscall(SYS_readlink, link, path, PATH_MAX / 2 - 1);
    if (got <= 0) return 0;
    n = got;
    path[n++] = '/';
  }
  strcpy(path + n, name);
  normalize(path);
  return below_root(path);
}

// --- what happens to it ---

static void put_all(int fd, const void *bytes, size_t n) {
  while (n) {
    ssize_t done = syscall(SYS_write, fd, bytes, n);
    if (done < 0) abort();  // a record with a hole would prove nothing
    bytes = (const char *)bytes + done;
    n -= done;
  }
}

// Decides about a call, and notes it where calls are traced.
static int strike(int kind, const char *path) {
  int verdict = PASS, kept = errno;
  pthread_mutex_lock(&lock);
  if (shim.trace >= 0) {
    char line[PATH_MAX + 32];
    put_all(shim.trace, line, snprintf(line, sizeof line, "%s %s\n", name_of(kind), path));
  }
  int takes = shim.error || kind & (READ | WRITE);
  if (shim.nth && shim.kinds & kind && takes) {
    long count = ++shim.count;
    if (count == shim.nth || (count > shim.nth && !shim.once)) {
      if (count == shim.nth) {
        const char *how = shim.error ? strerrorname_np(shim.error) : "half";
        snprintf(shim.fired, sizeof shim.fired, "%s %s %s", how, name_of(kind), path);
      }
      verdict = shim.error ? FAIL : SHORT;
    }
  }
  int error = shim.error;
  pthread_mutex_unlock(&lock);
  errno = verdict == FAIL ? error : kept;
  return verdict;
}

// Writes down one change: kind, inode, number, then two paths and the bytes, lengths first.
static void note(const char *kind, unsigned long long inode, long long number, const char *path,
                 const char *other, const void *bytes, size_t n) {
  char head[128];
  int kept = errno;
  size_t first = path ? strlen(path) : 0, second = other ? strlen(other) : 0;
  int length = snprintf(head, sizeof head, "%s %llu %lld %zu %zu %zu\n", kind, inode, number, first,
                        second, n);
  put_all(shim.record, head, length);
  put_all(shim.record, path, first);
  put_all(shim.record, other, second);
  put_all(shim.record, bytes, n);
  errno = kept;
}

static unsigned long long inode_of(int fd) {
  struct stat about;
  return REAL(fstat)(fd, &about) ? 0 : about.st_ino;
}

static unsigned long long inode_at(const char *path) {
  struct stat about;
  return REAL(lstat)(path, &about) ? 0 : about.st_ino;
}

// Calls `call`, and if it changed something notes it; nothing else changes meanwhile.
#define CHANGE(result, call, ...)             \
  do {                                        \
    pthread_mutex_lock(&lock);                \
    result = call;                            \
    if (shim.record >= 0 && (result) >= 0) {  \
      note(__VA_ARGS__);                      \
    }                                         \
    pthread_mutex_unlock(&lock);              \
  } while (0)

// --- opening ---

static int open_ours(int folder, const char *name, int flags, mode_t mode, const char *path) {
  if (strike(flags & O_CREAT ? CREATE : OPEN, path) == FAIL) return -1;
  if (shim.record < 0) return REAL(openat)(folder, name, flags, mode);
  pthread_mutex_lock(&lock);
  int there = inode_at(path) != 0;
  int fd = REAL(openat)(folder, name, flags, mode);
  if (fd >= 0 && shim.record >= 0) {
    if ((flags & O_TMPFILE) == O_TMPFILE)
      note("unknown", 0, 0, "O_TMPFILE", path, 0, 0);
    else if (!there)
      note("create", inode_of(fd), 0, path, 0, 0, 0);
    else if (flags & O_TRUNC && (flags & O_ACCMODE) != O_RDONLY)
      note("truncate", inode_of(fd), 0, path, 0, 0, 0);
  }
  pthread_mutex_unlock(&lock);
  return fd;
}

#define TAKE_MODE(flags)                                  \
  mode_t mode = 0;                                        \
  if ((flags) & O_CREAT || ((flags) & O_TMPFILE) == O_TMPFILE) { \
    va_list more;                                         \
    va_start(more, flags);                                \
    mode = va_arg(more, mode_t);                          \
    va_end(more);                                         \
  }

#define DEFINE_OPEN(name)                                                     \
  int name(const char *file, int flags, ...) {                                \
    TAKE_MODE(flags)                                                          \
    char path[PATH_MAX];                                                      \
    if (!path_ours(AT_FDCWD, file, path)) return REAL(name)(file, flags, mode); \
    return open_ours(AT_FDCWD, file, flags, mode, path);                      \
  }
#define DEFINE_OPENAT(name)                                                   \
  int name(int folder, const char *file, int flags, ...) {                    \
    TAKE_MODE(flags)                                                          \
    char path[PATH_MAX];                                                      \
    if (!path_ours(folder, file, path)) return REAL(name)(folder, file, flags, mode); \
    return open_ours(folder, file, flags, mode, path);                        \
  }
DEFINE_OPEN(open)
DEFINE_OPEN(open64)
DEFINE_OPENAT(openat)
DEFINE_OPENAT(openat64)

int __open_2(const char *file, int flags) { return open(file, flags); }
int __open64_2(const char *file, int flags) { return open(file, flags); }
int __openat_2(int folder, const char *file, int flags) { return openat(folder, file, flags); }
int __openat64_2(int folder, const char *file, int flags) { return openat(folder, file, flags); }
int creat(const char *file, mode_t mode) { return open(file, O_CREAT | O_WRONLY | O_TRUNC, mode); }
int creat64(const char *file, mode_t mode) { return creat(file, mode); }

// --- reading ---

#define DEFINE_READ(name, parameters, call)\
  ssize_t name parameters {                         \
    char path[PATH_MAX];                            \
    if (fd_ours(fd, path)) {                        \
      int verdict = strike(READ, path);             \
      if (verdict == FAIL) return -1;               \
      if (verdict == SHORT && n > 1) n /= 2;        \
    }                                               \
    return REAL(name) call;                         \
  }
DEFINE_READ(read, (int fd, void *to, size_t n), (fd, to, n))
DEFINE_READ(pread, (int fd, void *to, size_t n, off_t at), (fd, to, n, at))
DEFINE_READ(pread64, (int fd, void *to, size_t n, off64_t at), (fd, to, n, at))
DEFINE_READ(readv, (int fd, const struct iovec *to, int n), (fd, to, n))
DEFINE_READ(preadv, (int fd, const struct iovec *to, int n, off_t at), (fd, to, n, at))
DEFINE_READ(preadv64, (int fd, const struct iovec *to, int n, off64_t at), (fd, to, n, at))
DEFINE_READ(preadv2, (int fd, const struct iovec *to, int n, off_t at, int how), (fd, to, n, at, how))
DEFINE_READ(preadv64v2, (int fd, const struct iovec *to, int n, off64_t at, int how), (fd, to, n, at, how))

// --- writing ---

// Where the next write goes: the end of a file that is only appended to, else where it stands.
static off_t position(int fd) {
  struct stat about;
  int flags = syscall(SYS_fcntl, fd, F_GETFL);
  if (flags & O_APPEND && !REAL(fstat)(fd, &about)) return about.st_size;
  return lseek(fd, 0, SEEK_CUR);
}

static void note_written(int fd, const struct iovec *from, off_t at, size_t n) {
  char path[PATH_MAX] = "";
  char *bytes = malloc(n + 1), *to = bytes;
  for (size_t left = n; left; from++) {
    size_t take = from->iov_len < left ? from->iov_len : left;
    memcpy(to, from->iov_base, take);
    to += take;
    left -= take;
  }
  fd_ours(fd, path);
  note("write", inode_of(fd), at, path, 0, bytes, n);
  free(bytes);
}

// Writes pieces to a file of the root, at `at` or where it stands (-1).
static ssize_t write_ours(int fd, const struct iovec *from, int pieces, off_t at, const char *path) {
  int verdict = strike(WRITE, path);
  if (verdict == FAIL) return -1;
  struct iovec first = from ? from[0] : (struct iovec){0};
  if (verdict == SHORT) {
    if (first.iov_len > 1) first.iov_len /= 2;
    from = &first;
    pieces = 1;
  }
  pthread_mutex_lock(&lock);
  off_t where = at >= 0 ? at : position(fd);
  ssize_t n = at >= 0 ? syscall(SYS_pwritev, fd, from, pieces, (long)at, 0L)
                      : syscall(SYS_writev, fd, from, pieces);
  if (shim.record >= 0 && n > 0) note_written(fd, from, where, n);
  pthread_mutex_unlock(&lock);
  return n;
}

#define DEFINE_WRITE(name, parameters, call, from, pieces, at)                        \
  ssize_t name parameters {                                                           \
    char path[PATH_MAX];                                                              \
    if (!fd_ours(fd, path)) return REAL(name) call;                                   \
    return write_ours(fd, from, pieces, at, path);                                    \
  }
#define ONE (&(struct iovec){(void *)bytes, n})
DEFINE_WRITE(write, (int fd, const void *bytes, size_t n), (fd, bytes, n), ONE, 1, -1)
DEFINE_WRITE(pwrite, (int fd, const void *bytes, size_t n, off_t at), (fd, bytes, n, at), ONE, 1, at)
DEFINE_WRITE(pwrite64, (int fd, const void *bytes, size_t n, off64_t at), (fd, bytes, n, at), ONE, 1, at)
DEFINE_WRITE(writev, (int fd, const struct iovec *all, int n), (fd, all, n), all, n, -1)
DEFINE_WRITE(pwritev, (int fd, const struct iovec *all, int n, off_t at), (fd, all, n, at), all, n, at)
DEFINE_WRITE(pwritev64, (int fd, const struct iovec *all, int n, off64_t at), (fd, all, n, at), all, n, at)
DEFINE_WRITE(pwritev2, (int fd, const struct iovec *all, int n, off_t at, int how), (fd, all, n, at, how), all, n, at)
DEFINE_WRITE(pwritev64v2, (int fd, const struct iovec *all, int n, off64_t at, int how), (fd, all, n, at, how), all, n, at)

// Reads back what the kernel has copied, since no bytes passed through here.
static void note_copied(int fd, off_t at, ssize_t n) {
  char own[64];
  char *bytes = malloc(n + 1);
  snprintf(own, sizeof own, "/proc/self/fd/%d", fd);
  int again = syscall(SYS_openat, AT_FDCWD, own, O_RDONLY | O_CLOEXEC, 0);
  if (syscall(SYS_pread64, again, bytes, n, at) != n) abort();
  syscall(SYS_close, again);
  note_written(fd, &(struct iovec){bytes, n}, at, n);
  free(bytes);
}

#define DEFINE_COPY(name, parameters, call, out, where)                \
  ssize_t name parameters {                                            \
    char path[PATH_MAX];                                               \
    if (!fd_ours(out, path)) return REAL(name) call;                   \
    if (strike(WRITE, path) == FAIL) return -1;                        \
    pthread_mutex_lock(&lock);                                         \
    off_t at = where;                                                  \
    ssize_t copied = REAL(name) call;                                  \
    if (shim.record >= 0 && copied > 0) note_copied(out, at, copied);  \
    pthread_mutex_unlock(&lock);                                       \
    return copied;                                                     \
  }
DEFINE_COPY(sendfile, (int out, int in, off_t *from, size_t n), (out, in, from, n), out, position(out))
DEFINE_COPY(sendfile64, (int out, int in, off64_t *from, size_t n), (out, in, from, n), out, position(out))
DEFINE_COPY(copy_file_range,
            (int in, off64_t *from, int out, off64_t *to, size_t n, unsigned flags),
            (in, from, out, to, n, flags), out, to ? *to : position(out))

// --- sizes, and what is promised to be on the disk ---

#define DEFINE_ON_FD(name, parameters, call, kind, text, number)              \
  int name parameters {                                                       \
    char path[PATH_MAX];                                                      \
    int result;                                                               \
    if (!fd_ours(fd, path)) return REAL(name) call;                           \
    if (strike(kind, path) == FAIL) return -1;                                \
    CHANGE(result, REAL(name) call, text, inode_of(fd), number, path, 0, 0, 0); \
    return result;                                                            \
  }
DEFINE_ON_FD(fsync, (int fd), (fd), SYNC, "fsync", 0)
DEFINE_ON_FD(fdatasync, (int fd), (fd), SYNC, "fsync", 0)
DEFINE_ON_FD(syncfs, (int fd), (fd), SYNC, "syncfs", 0)
DEFINE_ON_FD(ftruncate, (int fd, off_t n), (fd, n), TRUNCATE, "truncate", n)
DEFINE_ON_FD(ftruncate64, (int fd, off64_t n), (fd, n), TRUNCATE, "truncate", n)

#define DEFINE_TRUNCATE(name, type)                                                      \
  int name(const char *file, type n) {                                                   \
    char path[PATH_MAX];                                                                 \
    int result;                                                                          \
    if (!path_ours(AT_FDCWD, file, path)) return REAL(name)(file, n);                    \
    if (strike(TRUNCATE, path) == FAIL) return -1;                                       \
    CHANGE(result, REAL(name)(file, n), "truncate", inode_at(path), n, path, 0, 0, 0);   \
    return result;                                                                       \
  }
DEFINE_TRUNCATE(truncate, off_t)
DEFINE_TRUNCATE(truncate64, off64_t)

static long long size_of(int fd) {
  struct stat about;
  return REAL(fstat)(fd, &about) ? 0 : about.st_size;
}

// Returns an error number; `fallocate` turns it into errno.
#define DEFINE_ALLOCATE(name, parameters, call, refuse)                                       \
  int name parameters {                                                                       \
    char path[PATH_MAX];                                                                      \
    int result;                                                                               \
    if (!fd_ours(fd, path)) return REAL(name) call;                                           \
    if (strike(WRITE, path) == FAIL) return refuse;                                           \
    CHANGE(result, REAL(name) call, "truncate", inode_of(fd), size_of(fd), path, 0, 0, 0);    \
    return result;                                                                            \
  }
DEFINE_ALLOCATE(posix_fallocate, (int fd, off_t at, off_t n), (fd, at, n), errno)
DEFINE_ALLOCATE(posix_fallocate64, (int fd, off64_t at, off64_t n), (fd, at, n), errno)
DEFINE_ALLOCATE(fallocate, (int fd, int mode, off_t at, off_t n), (fd, mode, at, n), -1)
DEFINE_ALLOCATE(fallocate64, (int fd, int mode, off64_t at, off64_t n), (fd, mode, at, n), -1)

// --- names ---

static int rename_ours(int from, const char *old, int to, const char *new, unsigned flags) {
  char path[PATH_MAX], other[PATH_MAX];
  int result;
  int first = path_ours(from, old, path), second = path_ours(to, new, other);
  if (!first && !second) return syscall(SYS_renameat2, from, old, to, new, flags);
  if (strike(RENAME, path) == FAIL) return -1;
  CHANGE(result, syscall(SYS_renameat2, from, old, to, new, flags),
         first && second && !(flags & ~RENAME_NOREPLACE) ? "rename" : "unknown", 0, 0, path, other,
         0, 0);
  return result;
}
int rename(const char *old, const char *new) {
  return rename_ours(AT_FDCWD, old, AT_FDCWD, new, 0);
}
int renameat(int from, const char *old, int to, const char *new) {
  return rename_ours(from, old, to, new, 0);
}
int renameat2(int from, const char *old, int to, const char *new, unsigned flags) {
  return rename_ours(from, old, to, new, flags);
}

int linkat(int from, const char *old, int to, const char *new, int flags) {
  char path[PATH_MAX], other[PATH_MAX];
  int result;
  if (!path_ours(to, new, other)) return REAL(linkat)(from, old, to, new, flags);
  int both = path_ours(from, old, path);
  if (strike(LINK, other) == FAIL) return -1;
  CHANGE(result, REAL(linkat)(from, old, to, new, flags), both ? "link" : "unknown",
         inode_at(other), 0, path, other, 0, 0);
  return result;
}
int link(const char *old, const char *new) { return linkat(AT_FDCWD, old, AT_FDCWD, new, 0); }

int symlinkat(const char *target, int folder, const char *name) {
  char path[PATH_MAX];
  int result;
  if (!path_ours(folder, name, path)) return REAL(symlinkat)(target, folder, name);
  if (strike(LINK, path) == FAIL) return -1;
  CHANGE(result, REAL(symlinkat)(target, folder, name), "unknown", 0, 0, "symlink", path, 0, 0);
  return result;
}
int symlink(const char *target, const char *name) { return symlinkat(target, AT_FDCWD, name); }

int mkdirat(int folder, const char *name, mode_t mode) {
  char path[PATH_MAX];
  int result;
  if (!path_ours(folder, name, path)) return REAL(mkdirat)(folder, name, mode);
  if (strike(MKDIR, path) == FAIL) return -1;
  CHANGE(result, REAL(mkdirat)(folder, name, mode), "mkdir", inode_at(path), 0, path, 0, 0, 0);
  return result;
}
int mkdir(const char *name, mode_t mode) { return mkdirat(AT_FDCWD, name, mode); }

int unlinkat(int folder, const char *name, int flags) {
  char path[PATH_MAX];
  int result;
  if (!path_ours(folder, name, path)) return REAL(unlinkat)(folder, name, flags);
  if (strike(REMOVE, path) == FAIL) return -1;
  CHANGE(result, REAL(unlinkat)(folder, name, flags), "remove", 0, 0, path, 0, 0, 0);
  return result;
}
int unlink(const char *name) { return unlinkat(AT_FDCWD, name, 0); }
int rmdir(const char *name) { return unlinkat(AT_FDCWD, name, AT_REMOVEDIR); }
int remove(const char *name) {
  int result = unlink(name);
  return result && errno == EISDIR ? rmdir(name) : result;
}

// --- looking, and locks ---

DIR *opendir(const char *name) {
  char path[PATH_MAX];
  if (path_ours(AT_FDCWD, name, path) && strike(LIST, path) == FAIL) return 0;
  return REAL(opendir)(name);
}
DIR *fdopendir(int fd) {
  char path[PATH_MAX];
  if (fd_ours(fd, path) && strike(LIST, path) == FAIL) return 0;
  return REAL(fdopendir)(fd);
}

#define DEFINE_STAT(name, type)                                                     \
  int name(const char *file, struct type *about) {                                  \
    char path[PATH_MAX];                                                            \
    if (path_ours(AT_FDCWD, file, path) && strike(STAT, path) == FAIL) return -1;   \
    return REAL(name)(file, about);                                                 \
  }
#define DEFINE_STATAT(name, type)                                                   \
  int name(int folder, const char *file, struct type *about, int flags) {           \
    char path[PATH_MAX];                                                            \
    if (path_ours(folder, file, path) && strike(STAT, path) == FAIL) return -1;     \
    return REAL(name)(folder, file, about, flags);                                  \
  }
DEFINE_STAT(stat, stat)
DEFINE_STAT(lstat, stat)
DEFINE_STAT(stat64, stat64)
DEFINE_STAT(lstat64, stat64)
DEFINE_STATAT(fstatat, stat)
DEFINE_STATAT(fstatat64, stat64)

int flock(int fd, int how) {
  char path[PATH_MAX];
  if (fd_ours(fd, path) && strike(LOCK, path) == FAIL) return -1;
  return REAL(flock)(fd, how);
}

#define DEFINE_FCNTL(name)                                                         \
  int name(int fd, int command, ...) {                                             \
    char path[PATH_MAX];                                                           \
    va_list more;                                                                  \
    va_start(more, command);                                                       \
    void *argument = va_arg(more, void *);                                         \
    va_end(more);                                                                  \
    int locks = command == F_SETLK || command == F_SETLKW || command == F_OFD_SETLK || \
                command == F_OFD_SETLKW;                                           \
    if (locks && fd_ours(fd, path) && strike(LOCK, path) == FAIL) return -1;       \
    return REAL(name)(fd, command, argument);                                      \
  }
DEFINE_FCNTL(fcntl)
DEFINE_FCNTL(fcntl64)

// --- arming ---

// Opens a log outside of the root, out of the way of the program's own descriptors.
static int open_log(const char *file) {
  int fd = syscall(SYS_openat, AT_FDCWD, file, O_CREAT | O_WRONLY | O_APPEND | O_CLOEXEC, 0600);
  int high = syscall(SYS_fcntl, fd, F_DUPFD_CLOEXEC, 400);
  syscall(SYS_close, fd);
  return high;
}

// Arms it for the files below `root`, which is absolute and has no symbolic links. `record` and
// `trace` are files to append changes and all calls to, or null. The `nth` call of `kinds` fails
// with `error`; all later ones too, unless `once`.
void shim_arm(const char *root, const char *record, const char *trace, unsigned kinds, long nth,
              int error, int once) {
  pthread_mutex_lock(&lock);
  snprintf(shim.root, sizeof shim.root, "%s", root);
  shim.length = strlen(shim.root);
  shim.record = record ? open_log(record) : -1;
  shim.trace = trace ? open_log(trace) : -1;
  shim.kinds = kinds, shim.nth = nth, shim.error = error, shim.once = once;
  shim.count = 0;
  shim.fired[0] = 0;
  shim.armed = 1;
  pthread_mutex_unlock(&lock);
}

void shim_disarm(void) {
  pthread_mutex_lock(&lock);
  shim.armed = 0;
  if (shim.record >= 0) syscall(SYS_close, shim.record);
  if (shim.trace >= 0) syscall(SYS_close, shim.trace);
  shim.record = shim.trace = -1;
  shim.nth = 0;
  pthread_mutex_unlock(&lock);
}

// What the fault met, as "EIO write /path"; "" while it met nothing.
const char *shim_fired(void) { return shim.fired; }

// For processes that nobody arms from within: SHIM_ROOT, and SHIM_RECORD or SHIM_FAULT (kinds, nth,
// error, once). Their own children are left in peace.
__attribute__((constructor)) static void arm_by_environment(void) {
  const char *root = getenv("SHIM_ROOT"), *fault = getenv("SHIM_FAULT");
  unsigned kinds = 0;
  long nth = 0;
  int error = 0, once = 1;
  if (!root) return;
  if (fault) sscanf(fault, "%u,%ld,%d,%d", &kinds, &nth, &error, &once);
  shim_arm(root, getenv("SHIM_RECORD"), getenv("SHIM_TRACE"), kinds, nth, error, once);
  unsetenv("SHIM_ROOT");
}
