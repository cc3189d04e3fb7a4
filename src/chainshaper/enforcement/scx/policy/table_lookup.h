/* SPDX-License-Identifier: MIT OR GPL-2.0-only */
/*
 * The policy's maps, and what the table says about an instant.
 *
 * Nothing in here decides or changes anything.
 */
#ifndef TABLE_LOOKUP_H
#define TABLE_LOOKUP_H

#define NEVER (~0ULL)
#define SECOND 1000000000ULL
/* Queues; a server's is named by its id. */
#define BEST_EFFORT 1000
#define UNSORTED 1001			/* assigned threads, until the first table is in force */

/*
 * bpf_ktime_get_ns() may be some nanoseconds behind the clock that timers follow. Without slack, a
 * core that is kicked at the end of a slot could find three nanoseconds of it left, and go on.
 */
#define CLOCK_SLACK 200ULL

struct timer_of_cpu {
	struct bpf_timer timer;
};

struct cpu_state {
	u64 due;			/* when the kicker has promised to be back */
	u64 missed;			/* a `due` that was found to have passed, */
	u64 missed_at;			/* and when */
	u32 server;			/* that the running thread belongs to, or 0 */
	u32 priority;			/* of that server */
};

/* What a server's slots mean at one instant. */
struct moment {
	u64 slot_start;			/* of the open slot, absolute */
	u64 turn_start;			/* of the rotation period within it, absolute */
	u64 left;			/* of the open slot; 0: closed */
	u64 turn_left;
	u64 until_boundary;		/* where a slot starts or ends */
};

struct {
	__uint(type, BPF_MAP_TYPE_ARRAY);
	__uint(max_entries, TABLE_GENERATIONS * TABLE_MAX_SERVERS);
	__type(key, u32);
	__type(value, struct table_server);
} servers SEC(".maps");

struct {
	__uint(type, BPF_MAP_TYPE_ARRAY);
	__uint(max_entries, TABLE_GENERATIONS * TABLE_MAX_CPUS);
	__type(key, u32);
	__type(value, struct table_cpu);
} cpus SEC(".maps");

/*
 * instant << 2 | replaces << 1 | generation: that generation from the instant on, the other one
 * before it, which holds no table yet unless `replaces` is set. 0: there is no table.
 */
struct {
	__uint(type, BPF_MAP_TYPE_ARRAY);
	__uint(max_entries, 1);
	__type(key, u32);
	__type(value, u64);
} in_force SEC(".maps");

/* Server id by thread: ends with the thread, and no thread id is ever taken for another's. */
struct {
	__uint(type, BPF_MAP_TYPE_TASK_STORAGE);
	__uint(map_flags, BPF_F_NO_PREALLOC);
	__type(key, int);
	__type(value, u32);
} assignments SEC(".maps");

struct {
	__uint(type, BPF_MAP_TYPE_ARRAY);
	__uint(max_entries, TABLE_MAX_SERVERS);
	__type(key, u32);
	__type(value, struct table_counters);
} counters SEC(".maps");

struct {
	__uint(type, BPF_MAP_TYPE_ARRAY);
	__uint(max_entries, TABLE_MAX_CPUS);
	__type(key, u32);
	__type(value, struct cpu_state);
} cpu_states SEC(".maps");

struct {
	__uint(type, BPF_MAP_TYPE_ARRAY);
	__uint(max_entries, TABLE_MAX_CPUS);
	__type(key, u32);
	__type(value, struct timer_of_cpu);
} timers SEC(".maps");

struct {
	__uint(type, BPF_MAP_TYPE_ARRAY);
	__uint(max_entries, 1);
	__type(key, u32);
	__type(value, struct table_exit);
} ended SEC(".maps");

static __always_inline u64 time_to_decide_for(void)
{
	return bpf_ktime_get_ns() + CLOCK_SLACK;
}

static __always_inline u64 word_in_force(void)
{
	u32 zero = 0;
	u64 *word = bpf_map_lookup_elem(&in_force, &zero);

	return word ? READ_ONCE(*word) : 0;
}

static __always_inline u64 changes_at(void)
{
	return word_in_force() >> 2;
}

static __always_inline bool is_governed(u64 now)
{
	u64 word = word_in_force();

	return word && ((word & 2) || now >= word >> 2);
}

static __always_inline u32 generation_at(u64 now)
{
	u64 word = word_in_force();
	u32 generation = word & 1;

	return now >= word >> 2 ? generation : !generation;
}

static __always_inline struct table_server *find_server(u32 generation, u32 id)
{
	u32 key = generation * TABLE_MAX_SERVERS + id;
	struct table_server *s;

	if (!id || id >= TABLE_MAX_SERVERS)
		return 0;
	s = bpf_map_lookup_elem(&servers, &key);
	return s && s->cycle ? s : 0;
}

static __always_inline struct table_cpu *find_cpu(u32 generation, u32 cpu)
{
	u32 key = generation * TABLE_MAX_CPUS + cpu;

	return cpu < TABLE_MAX_CPUS ? bpf_map_lookup_elem(&cpus, &key) : 0;
}

static __always_inline u32 id_of(struct task_struct *p)
{
	u32 *id = bpf_task_storage_get(&assignments, p, 0, 0);

	return id ? *id : 0;
}

static __noinline int look_up(struct table_server *s, u64 now, struct moment *m)
{
	u64 phase, inside;
	u32 n;
	int i;

	if (!s || !m)
		return 0;
	m->slot_start = 0;
	m->turn_start = 0;
	m->left = 0;
	m->turn_left = 0;
	m->until_boundary = NEVER;
	n = s->slot_count;
	if (!s->cycle || !s->rotation || !n || n > TABLE_MAX_SLOTS)
		return 0;
	phase = (now - s->anchor) % s->cycle;
	bpf_for(i, 0, n) {
		if (i < 0 || i >= TABLE_MAX_SLOTS)	/* for the verifier */
			break;
		if (phase >= s->slots[i].end)
			continue;
		if (phase < s->slots[i].start) {
			m->until_boundary = s->slots[i].start - phase;
		} else {
			m->slot_start = now - phase + s->slots[i].start;
			m->left = s->slots[i].end - phase;
			m->until_boundary = m->left;
		}
		break;
	}
	if (m->until_boundary == NEVER)
		m->until_boundary = s->cycle - phase + s->slots[0].start;
	if (m->left) {
		inside = (now - m->slot_start) % s->rotation;
		m->turn_start = now - inside;
		m->turn_left = s->rotation - inside;
		if (m->turn_left > m->left)
			m->turn_left = m->left;
	}
	return 0;
}

/* Whether turns matter: a thread by itself is not interrupted for them. */
static __always_inline bool is_shared(u32 id, u32 cpu)
{
	struct cpu_state *state = bpf_map_lookup_elem(&cpu_states, &cpu);

	return scx_bpf_dsq_nr_queued(id) + (state && state->server == id) > 1;
}

/*
 * The next instant at which this core has to decide anew, whatever happens until then. (A thread
 * that comes to share a server in the middle of a slot waits for the tick to end the present turn.)
 */
static __noinline u64 next_boundary(u32 cpu, u64 now)
{
	u32 generation = generation_at(now);
	u64 change = changes_at(), soonest = SECOND;
	struct table_cpu *c = find_cpu(generation, cpu);
	struct table_server *s;
	struct moment m;
	int i;

	if (c) {
		bpf_for(i, 0, TABLE_MAX_SERVERS_PER_CPU) {
			if (i < 0 || i >= TABLE_MAX_SERVERS_PER_CPU || i >= c->count)
				break;
			s = find_server(generation, c->ids[i]);
			if (!s)
				continue;
			look_up(s, now, &m);
			if (m.until_boundary < soonest)
				soonest = m.until_boundary;
			if (m.left && m.turn_left < soonest && is_shared(c->ids[i], cpu))
				soonest = m.turn_left;
		}
	}
	if (change > now && change - now < soonest)
		soonest = change - now;
	return now + soonest;
}

#endif
