// A low thread has a mutex while a middle one takes their core; a high one waits for the mutex.
// Prints how long the high one waited, in milliseconds. With MIDDLEWARE it is the library that makes
// the mutex, as a DDS does; as a program it takes the core, and a word when the library is to make it.
#define _GNU_SOURCE
#include <pthread.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

#ifdef MIDDLEWARE
void make_mutex(pthread_mutex_t *mutex) { pthread_mutex_init(mutex, NULL); }
#else
void make_mutex(pthread_mutex_t *mutex);

static pthread_mutex_t mutex;
static volatile int locked, in_between;

static double now(void) {
  struct timespec at;
  clock_gettime(CLOCK_MONOTONIC, &at);
  return 1e3 * at.tv_sec + at.tv_nsec / 1e6;
}

static void spend(double ms) {
  for (struct timespec used = {0, 0}; 1e3 * used.tv_sec + used.tv_nsec / 1e6 < ms;)
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &used);
}

static void become(int policy, int priority, int core) {
  const struct sched_param wanted = {priority};
  cpu_set_t cores;
  CPU_ZERO(&cores);
  CPU_SET(core, &cores);
  if (sched_setscheduler(0, policy, &wanted) != 0) exit(3);
  if (sched_setaffinity(0, sizeof(cores), &cores) != 0) exit(3);
}

static void *low(void *core) {
  become(SCHED_OTHER, 0, *(int *)core);
  pthread_mutex_lock(&mutex);
  locked = 1;
  spend(20);
  pthread_mutex_unlock(&mutex);
  return NULL;
}

static void *middle(void *core) {
  become(SCHED_FIFO, 10, *(int *)core);
  in_between = 1;
  spend(200);
  return NULL;
}

int main(int count, char **words) {
  int core = atoi(words[1]);
  pthread_t threads[2];
  become(SCHED_FIFO, 20, core);  // from here on: what else runs here must not let the low one end before
  if (count > 2)
    make_mutex(&mutex);
  else
    pthread_mutex_init(&mutex, NULL);
  pthread_create(&threads[0], NULL, low, &core);
  while (!locked) usleep(100);
  pthread_create(&threads[1], NULL, middle, &core);
  while (!in_between) usleep(100);
  const double since = now();
  pthread_mutex_lock(&mutex);
  printf("%.1f\n", now() - since);
  pthread_mutex_unlock(&mutex);
  return 0;
}
#endif
