// Counts calls of malloc for at least 1 MB in a process that loads this in front (LD_PRELOAD).
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdlib.h>

static _Atomic uint64_t count;

uint64_t large(void) { return atomic_load(&count); }

void * malloc(size_t size) {
  static void * (*next)(size_t);
  if (next == NULL) next = (void * (*)(size_t))dlsym(RTLD_NEXT, "malloc");
  if (size >= 1000000) atomic_fetch_add(&count, 1);
  return next(size);
}
