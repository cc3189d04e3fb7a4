/*
 * A thread that wants the core, and writes down when it had it.
 *
 *   spin LOG CORE                            wants it always
 *   spin LOG CORE ANCHOR PERIOD OFFSET WORK  wants it for WORK ns of computing, each period
 *
 * On SIGTERM, LOG gets its run windows: pairs of 64-bit CLOCK_MONOTONIC instants. A window is
 * split where two looks at the clock lie more than GAP apart. CORE -1 stands for any.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <sched.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <time.h>

#define GAP 20000LL
#define MOST 200000
#define SECOND 1000000000LL

static long long windows[MOST][2];
static long count;
static volatile sig_atomic_t ended;

static long long read_clock(clockid_t clock)
{
	struct timespec t;

	clock_gettime(clock, &t);
	return t.tv_sec * SECOND + t.tv_nsec;
}

static void look_at_clock(void)
{
	long long now = read_clock(CLOCK_MONOTONIC);

	if (count && now - windows[count - 1][1] <= GAP) {
		windows[count - 1][1] = now;
	} else if (count < MOST) {
		windows[count][0] = windows[count][1] = now;
		count++;
	}
}

static void sleep_until(long long instant)
{
	struct timespec t = { instant / SECOND, instant % SECOND };

	while (!ended && clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL) == EINTR)
		;
}

static void work_periodically(char **argument)
{
	long long anchor = atoll(argument[0]), period = atoll(argument[1]);
	long long offset = atoll(argument[2]), work = atoll(argument[3]), release, start;

	release = read_clock(CLOCK_MONOTONIC);
	release += period - (release - anchor - offset) % period;
	for (; !ended; release += period) {
		sleep_until(release);
		start = read_clock(CLOCK_THREAD_CPUTIME_ID);
		while (!ended && read_clock(CLOCK_THREAD_CPUTIME_ID) - start < work)
			look_at_clock();
	}
}

static void on_signal(int number)
{
	(void)number;
	ended = 1;
}

int main(int argc, char **argv)
{
	int core = atoi(argv[2]);
	cpu_set_t cores;
	FILE *log;

	signal(SIGTERM, on_signal);
	CPU_ZERO(&cores);
	CPU_SET(core, &cores);
	if ((core >= 0 && sched_setaffinity(0, sizeof(cores), &cores)) || mlockall(MCL_CURRENT)) {
		perror("spin");
		return 1;
	}
	puts("ready");
	fflush(stdout);
	if (argc > 3)
		work_periodically(argv + 3);
	while (!ended)
		look_at_clock();
	log = fopen(argv[1], "w");
	if (!log || fwrite(windows, sizeof(windows[0]), count, log) != (size_t)count || fclose(log)) {
		perror(argv[1]);
		return 1;
	}
	return count == MOST;
}
