/* SPDX-License-Identifier: MIT OR GPL-2.0-only */
/*
 * The maps between the policy (table.bpf.c) and its loader (../back_end.py). All times are
 * nanoseconds of CLOCK_MONOTONIC.
 */
#ifndef TABLE_ABI_H
#define TABLE_ABI_H

#define TABLE_MAX_SERVERS 128		/* ids 1 to 127; 0 means best effort */
#define TABLE_MAX_SLOTS 64		/* of one server */
#define TABLE_MAX_SERVERS_PER_CPU 32
#define TABLE_MAX_CPUS 512

/* Instead of a server id: a thread of the loader that goes from core to core. */
#define TABLE_VISITOR 0xffffffffU

struct table_slot {
	unsigned long long start, end;	/* half open, after the start of a cycle */
};

/* Key: id. A cycle of 0: there is no such server. */
struct table_server {
	unsigned long long cycle;
	unsigned long long rotation;	/* how long a thread of many has its turn */
	unsigned int cpu;
	unsigned int priority;		/* smaller is better */
	unsigned int slot_count, pad;
	struct table_slot slots[TABLE_MAX_SLOTS];	/* ascending, disjoint */
};

/*
 * A word, instant << 2 | replaces << 1 | place: from the instant on, cycles have started at the
 * anchor in this place, in the past; before, at the other one, or not at all unless it `replaces`
 * that. 0: the table is not in force yet.
 */
struct table_in_force {
	unsigned long long word, anchors[2];
};

/* Key: cpu. */
struct table_cpu {
	unsigned int count;
	unsigned int ids[TABLE_MAX_SERVERS_PER_CPU];	/* best priority first */
};

/* Key: server id. Written by the policy. */
struct table_counters {
	unsigned long long slots, late_entries, longest_lateness, overruns;
	unsigned long long open_since;	/* start of the slot that is open; 0: none is */
	unsigned long long turn;	/* start of the rotation period that its runner was chosen in */
};

/* Why the kernel ended the policy; a kind of 0: it has not. */
struct table_exit {
	int kind;
	char reason[64];
	char message[192];
};

/* Fixed before the policy is loaded, so that the verifier leaves out what is not used. */
struct table_config {
	unsigned int has_timer;		/* 0 on PREEMPT_RT, which refuses bpf_timer */
	unsigned int cpu_count;		/* one more than the highest number of a core */
};

struct table_instant {			/* as struct timespec */
	long long seconds, nanoseconds;
};

/* What a kicker gets from table_boundary: until when to sleep, and until when then once more. */
struct table_wake {
	struct table_instant boundary, planning;
};

#endif
