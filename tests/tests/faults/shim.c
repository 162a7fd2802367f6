/* A disk that is slow or fails, and a clock of the day that steps, for one process: preloaded into a daemon by the tests.
 *
 * What is wrong at the moment is in a file that both sides have mapped (RATN_FAULTS): milliseconds that every sync takes, the error
 * of every sync, the error of every write to a file of the daemon's state, and by how many seconds the clock of the day is wrong. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/types.h>
#include <time.h>
#include <unistd.h>

struct faults {
  volatile int64_t sync_ms, sync_error, write_error, clock_s;
};

static struct faults *faults;

__attribute__((constructor)) static void begin(void) {
  const char *path = getenv("RATN_FAULTS");
  int file = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
  if (file < 0) return;
  void *mapped = mmap(NULL, sizeof *faults, PROT_READ, MAP_SHARED, file, 0);
  if (mapped != MAP_FAILED) faults = mapped;
  close(file);
}

static int is_state(int file) {
  char link[64], path[4096];
  snprintf(link, sizeof link, "/proc/self/fd/%d", file);
  ssize_t length = readlink(link, path, sizeof path - 1);
  if (length < 0) return 0;
  path[length] = 0;
  return strstr(path, "/state/") != NULL;
}

static int sync_fails(void) {
  if (!faults) return 0;
  if (faults->sync_ms) {
    struct timespec time = {faults->sync_ms / 1000, faults->sync_ms % 1000 * 1000000};
    nanosleep(&time, NULL);
  }
  if (faults->sync_error) errno = (int)faults->sync_error;
  return faults->sync_error != 0;
}

static int write_fails(int file) {
  if (!faults || !faults->write_error || !is_state(file)) return 0;
  errno = (int)faults->write_error;
  return 1;
}

int fdatasync(int file) {
  static int (*real)(int);
  if (!real) real = (int (*)(int))dlsym(RTLD_NEXT, "fdatasync");
  return sync_fails() ? -1 : real(file);
}

int fsync(int file) {
  static int (*real)(int);
  if (!real) real = (int (*)(int))dlsym(RTLD_NEXT, "fsync");
  return sync_fails() ? -1 : real(file);
}

ssize_t write(int file, const void *bytes, size_t count) {
  static ssize_t (*real)(int, const void *, size_t);
  if (!real) real = (ssize_t(*)(int, const void *, size_t))dlsym(RTLD_NEXT, "write");
  return write_fails(file) ? -1 : real(file, bytes, count);
}

ssize_t pwrite64(int file, const void *bytes, size_t count, off64_t at) {
  static ssize_t (*real)(int, const void *, size_t, off64_t);
  if (!real) real = (ssize_t(*)(int, const void *, size_t, off64_t))dlsym(RTLD_NEXT, "pwrite64");
  return write_fails(file) ? -1 : real(file, bytes, count, at);
}

int clock_gettime(clockid_t clock, struct timespec *time) {
  static int (*real)(clockid_t, struct timespec *);
  if (!real) real = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
  int result = real(clock, time);
  if (!result && faults && clock == CLOCK_REALTIME) time->tv_sec += faults->clock_s;
  return result;
}
