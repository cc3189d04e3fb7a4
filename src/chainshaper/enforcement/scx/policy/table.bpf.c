// SPDX-License-Identifier: MIT OR GPL-2.0-only
/*
 * Table-driven reservation servers as a sched_ext policy.
 *
 * A server has slots that repeat every cycle, on one core. Its threads run inside these slots and
 * at no other time; of several open servers the best priority runs; threads of one server take
 * turns; everything else ("best effort") runs when no server's thread wants to. Each server has a
 * queue, best effort another. A core that decides (dispatch) looks the present time up in the table.
 * Slots are exact because every core is made to decide at each boundary, where a slot starts or
 * ends or a turn is over:
 *
 *  - normally by a timer per core whose callback kicks the core;
 *  - on PREEMPT_RT by a SCHED_FIFO thread per core ("kicker", of the loader) that sleeps from
 *    boundary to boundary: its running pushes the present thread back to its queue, and when it
 *    sleeps again the core decides anew. Should it stop, decisions find its boundary overdue and
 *    end the policy: a table that only the tick follows is none.
 *
 * The loader writes when cycles start beside what is in force, with the instant from which on it
 * counts, so all cores change over at once. Threads that waited for the first instant are in a
 * queue that is emptied first when it has come: `running` has each sent to where it belongs now.
 *
 * Everything fails open: the kernel goes back to its fair class when the loader's link is closed,
 * by whatever, and when a runnable thread has not run for half a minute.
 */
#include <linux/types.h>
#include <bpf/bpf_helpers.h>
#include <bpf/bpf_tracing.h>
#include <bpf/bpf_core_read.h>
#include "kernel_abi.h"
#include "table_abi.h"

#define LATE 100000ULL
#define KICKER_GRACE 5000000ULL		/* virtual machines stand still for longer than 1 ms */
#define LONGEST_SLEEP 20000000ULL	/* of a kicker; after that it looks for a new table */
#define PLANNING_PAUSE 200000ULL
#define TURN_BIT 23			/* of the clock: about 8 ms */
#define BEST_EFFORT_SLICE 5000000ULL

const volatile struct table_config config SEC(".rodata.config") = {
	.has_timer = 1,
	.cpu_count = 1,
};

/* Lets a test see that this object was compiled from these sources. */
const volatile char source_digest[] = SOURCE_DIGEST;

#define NEVER (~0ULL)
#define SECOND 1000000000ULL
/* Queues; a server's is named by its id. */
#define BEST_EFFORT 1000
#define UNSORTED 1001			/* assigned threads, until the table is in force */

/* bpf_ktime_get_ns() may be some ns behind the timers' clock: the end of a slot would be missed. */
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

#define ARRAY(name, count, element) \
	struct { \
		__uint(type, BPF_MAP_TYPE_ARRAY); \
		__uint(max_entries, count); \
		__type(key, u32); \
		__type(value, element); \
	} name SEC(".maps")

ARRAY(servers, TABLE_MAX_SERVERS, struct table_server);
ARRAY(cpus, TABLE_MAX_CPUS, struct table_cpu);
ARRAY(in_force, 1, struct table_in_force);
/* Server id by thread: ends with the thread, and no thread id is ever taken for another's. */
struct {
	__uint(type, BPF_MAP_TYPE_TASK_STORAGE);
	__uint(map_flags, BPF_F_NO_PREALLOC);
	__type(key, int);
	__type(value, u32);
} assignments SEC(".maps");
ARRAY(counters, TABLE_MAX_SERVERS, struct table_counters);
ARRAY(cpu_states, TABLE_MAX_CPUS, struct cpu_state);
ARRAY(timers, TABLE_MAX_CPUS, struct timer_of_cpu);
ARRAY(ended, 1, struct table_exit);

static __always_inline u64 time_to_decide_for(void)
{
	return bpf_ktime_get_ns() + CLOCK_SLACK;
}

static __always_inline u64 word_in_force(void)
{
	u32 zero = 0;
	struct table_in_force *f = bpf_map_lookup_elem(&in_force, &zero);

	return f ? READ_ONCE(f->word) : 0;
}

static __always_inline bool is_governed(u64 now)
{
	u64 word = word_in_force();

	return word && ((word & 2) || now >= word >> 2);
}

static __always_inline u64 anchor_at(u64 now)
{
	u32 zero = 0;
	struct table_in_force *f = bpf_map_lookup_elem(&in_force, &zero);
	u64 word = word_in_force();

	return f ? f->anchors[(word ^ (now < word >> 2)) & 1] : 0;
}

/* Of a thread or core, while the table is in force. */
static __always_inline struct table_server *find_server(bool governed, u32 id)
{
	struct table_server *s;

	if (!governed || !id || id >= TABLE_MAX_SERVERS)
		return 0;
	s = bpf_map_lookup_elem(&servers, &id);
	return s && s->cycle ? s : 0;
}

static __always_inline u32 id_of(struct task_struct *p)
{
	u32 *id = bpf_task_storage_get(&assignments, p, 0, 0);

	return id ? *id : 0;
}

static __noinline int look_up(struct table_server *s, u64 now, u64 anchor, struct moment *m)
{
	u64 phase, inside;
	u32 n;
	int i;

	if (!s || !m)
		return 0;
	*m = (struct moment){ .until_boundary = NEVER };
	n = s->slot_count;
	if (!s->cycle || !s->rotation || !n || n > TABLE_MAX_SLOTS)
		return 0;
	phase = (now - anchor) % s->cycle;
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

/* When this core has to decide anew at the latest, but for a thread that has just come to share. */
static __noinline u64 next_boundary(u32 cpu, u64 now)
{
	u64 anchor = anchor_at(now), change = word_in_force() >> 2, soonest = SECOND;
	struct table_cpu *c = is_governed(now) ? bpf_map_lookup_elem(&cpus, &cpu) : 0;
	struct table_server *s;
	struct moment m;
	int i;

	if (c) {
		bpf_for(i, 0, TABLE_MAX_SERVERS_PER_CPU) {
			if (i < 0 || i >= TABLE_MAX_SERVERS_PER_CPU || i >= c->count)
				break;
			s = find_server(1, c->ids[i]);
			if (!s)
				continue;
			look_up(s, now, anchor, &m);
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

/* Whether the thread that ran last in this server was chosen in the present rotation period. */
static __always_inline bool has_its_turn(u32 id, struct moment *m)
{
	struct table_counters *k = bpf_map_lookup_elem(&counters, &id);

	return m->left && k && k->turn == m->turn_start;
}

static __always_inline void take_turn(u32 id, struct moment *m)
{
	struct table_counters *k = bpf_map_lookup_elem(&counters, &id);

	if (k)
		k->turn = m->turn_start;
}

/* The core's first decision inside a slot is its opening, the first one after it its end. */
static __noinline int count(u32 id, struct moment *m, u64 now, bool wants_to_run)
{
	struct table_counters *k = bpf_map_lookup_elem(&counters, &id);
	u64 change = word_in_force() >> 2, entry, lateness;

	if (!k || !m || k->open_since == m->slot_start)
		return 0;
	if (k->open_since && wants_to_run)
		k->overruns++;
	k->open_since = m->slot_start;
	if (!m->slot_start)
		return 0;
	/* other cycles may begin within a slot */
	entry = change <= now && change > m->slot_start ? change : m->slot_start;
	now -= CLOCK_SLACK;
	lateness = now > entry ? now - entry : 0;
	k->slots++;
	if (lateness > LATE)
		k->late_entries++;
	if (lateness > k->longest_lateness)
		k->longest_lateness = lateness;
	return 0;
}

s32 SEC("struct_ops/table_select_cpu")
BPF_PROG(table_select_cpu, struct task_struct *p, s32 previous, u64 wake_flags)
{
	u32 id = id_of(p);
	struct table_server *s = find_server(is_governed(time_to_decide_for()), id);
	bool is_idle = 0;

	if (id == TABLE_VISITOR)
		return previous;
	if (s)
		return s->cpu;		/* a hint: the kernel looks at the affinity */
	return scx_bpf_select_cpu_dfl(p, previous, wake_flags, &is_idle);
}

static __always_inline void enqueue_freely(struct task_struct *p, u64 queue, u64 flags)
{
	s32 idle;

	if (flags & SCX_ENQ_LAST) {
		insert(p, SCX_DSQ_LOCAL, BEST_EFFORT_SLICE, flags);
		return;
	}
	if ((p->flags & PF_KTHREAD) && p->nr_cpus_allowed == 1) {
		/* work of the kernel for this core: short, and waited for by others */
		insert(p, SCX_DSQ_LOCAL, BEST_EFFORT_SLICE, flags | SCX_ENQ_PREEMPT);
		return;
	}
	insert(p, queue, BEST_EFFORT_SLICE, flags);
	idle = scx_bpf_pick_idle_cpu(p->cpus_ptr, 0);
	if (idle >= 0)
		scx_bpf_kick_cpu(idle, SCX_KICK_IDLE);
}

SEC("struct_ops/table_enqueue")
void BPF_PROG(table_enqueue, struct task_struct *p, u64 flags)
{
	u64 now = time_to_decide_for();
	u32 id = id_of(p), cpu;
	struct table_server *s = find_server(is_governed(now), id);
	struct cpu_state *state;
	struct moment m;

	if (id == TABLE_VISITOR) {
		insert(p, SCX_DSQ_LOCAL, BEST_EFFORT_SLICE, flags | SCX_ENQ_PREEMPT);
		return;
	}
	if (!s) {
		enqueue_freely(p, id && !is_governed(now) ? UNSORTED : BEST_EFFORT, flags);
		return;
	}
	look_up(s, now, anchor_at(now), &m);
	/* pushed out by a higher class during its turn: it keeps its place */
	if ((flags & SCX_ENQ_REENQ) && has_its_turn(id, &m))
		flags |= SCX_ENQ_HEAD;
	insert(p, id, BEST_EFFORT_SLICE, flags);

	cpu = s->cpu;
	state = bpf_map_lookup_elem(&cpu_states, &cpu);
	if (m.left && state && (!state->server || s->priority < state->priority))
		scx_bpf_kick_cpu(cpu, SCX_KICK_PREEMPT);
}

/* Give the core to an open server: to the thread that has its turn, else to the next one. */
static __always_inline bool run_server(u32 id, struct moment *m, struct task_struct *prev,
				       bool prev_is_ours)
{
	if (prev_is_ours && has_its_turn(id, m)) {
		set_slice(prev, m->turn_left);
		return 1;
	}
	if (move_to_local(id))
		return 1;
	if (prev_is_ours) {		/* nobody else wants to run in this server */
		set_slice(prev, m->turn_left);
		take_turn(id, m);
		return 1;
	}
	return 0;
}

/*
 * The kicker outranks all here: were it able to run, it would have. After a standstill of the
 * machine its interrupt may be pending, so it has to be overdue in two decisions, some time apart.
 */
static __always_inline void check_kicker(u32 cpu, u64 now)
{
	/* not const: the verifier takes this for memory that may be written to */
	static char format[] = "the kicker of core %d has stopped, %d us overdue";
	struct cpu_state *state = bpf_map_lookup_elem(&cpu_states, &cpu);
	unsigned long long data[2] = { cpu };

	if (config.has_timer || !state || !state->due || now < state->due + KICKER_GRACE)
		return;
	if (state->missed != state->due) {
		state->missed = state->due;
		state->missed_at = now;
	}
	if (now < state->missed_at + KICKER_GRACE)
		return;
	data[1] = (now - state->due) / 1000;
	scx_bpf_error_bstr(format, data, sizeof(data));
}

SEC("struct_ops/table_dispatch")
void BPF_PROG(table_dispatch, s32 cpu, struct task_struct *prev)
{
	u64 now = time_to_decide_for(), anchor = anchor_at(now);
	u32 id, prev_id = 0, key = cpu;
	bool governed = is_governed(now);
	struct table_cpu *c = governed ? bpf_map_lookup_elem(&cpus, &key) : 0;
	bool prev_wants = prev && (prev->scx.flags & SCX_TASK_QUEUED), decided = 0;
	struct table_server *s;
	struct moment m;
	int i;

	check_kicker(cpu, now);
	if (prev_wants)
		prev_id = id_of(prev);
	/* without a table yet, they take turns with best effort; nobody may starve */
	if (governed || (now >> TURN_BIT & 1))
		decided = move_to_local(UNSORTED);
	if (c) {
		bpf_for(i, 0, TABLE_MAX_SERVERS_PER_CPU) {
			if (i < 0 || i >= TABLE_MAX_SERVERS_PER_CPU || i >= c->count)
				break;
			id = c->ids[i];
			s = find_server(1, id);
			if (!s)
				continue;
			look_up(s, now, anchor, &m);
			count(id, &m, now, prev_id == id || scx_bpf_dsq_nr_queued(id) > 0);
			if (!decided && m.left)
				decided = run_server(id, &m, prev, prev_wants && prev_id == id);
		}
	}
	if (decided || move_to_local(BEST_EFFORT) || move_to_local(UNSORTED))
		return;
	/* a closed server's thread keeps no slice: by SCX_OPS_ENQ_LAST it waits in the queue */
	if (prev_wants && !find_server(governed, prev_id))
		set_slice(prev, BEST_EFFORT_SLICE);
}

SEC("struct_ops/table_running")
void BPF_PROG(table_running, struct task_struct *p)
{
	u64 now = time_to_decide_for();
	u32 cpu = scx_bpf_task_cpu(p), id = id_of(p);
	struct table_server *s = find_server(is_governed(now), id);
	struct cpu_state *state = bpf_map_lookup_elem(&cpu_states, &cpu);
	struct moment m;

	if (!state)
		return;
	state->server = s ? id : 0;
	state->priority = s ? s->priority : ~0u;
	if (!s)
		return;
	look_up(s, now, anchor_at(now), &m);
	take_turn(id, &m);
	set_slice(p, m.turn_left ?: 1);
	/* assigned while it waited among best effort, or on another core: decide anew at once */
	if (!m.left || s->cpu != cpu)
		scx_bpf_kick_cpu(cpu, SCX_KICK_PREEMPT);
}

SEC("struct_ops/table_stopping")
void BPF_PROG(table_stopping, struct task_struct *p, bool runnable)
{
	u32 cpu = scx_bpf_task_cpu(p);
	struct cpu_state *state = bpf_map_lookup_elem(&cpu_states, &cpu);

	if (state) {
		state->server = 0;
		state->priority = ~0u;
	}
}

/* A higher class takes the core: the local queue, which would run on afterwards, is sorted anew. */
SEC("struct_ops/table_cpu_release")
void BPF_PROG(table_cpu_release, s32 cpu, struct scx_cpu_release_args *args)
{
	reenqueue_local();
}

static int at_boundary(void *map, u32 *key, struct timer_of_cpu *t)
{
	u32 zero = 0, cpu = *key;
	struct table_exit *e = bpf_map_lookup_elem(&ended, &zero);

	if (!e || e->kind)
		return 0;
	bpf_timer_start(&t->timer, next_boundary(cpu, time_to_decide_for()),
			BPF_F_TIMER_ABS | BPF_F_TIMER_CPU_PIN);
	scx_bpf_kick_cpu(cpu, SCX_KICK_PREEMPT);
	return 0;
}

/*
 * Have the calling core decide at its next boundary. With a timer, which is pinned to the core that
 * starts it, the loader runs this once on each core after each change; without, the
 * core's kicker again and again: it sleeps until the boundary, a little longer since planning
 * would delay those who wait for it, and then plans anew.
 */
SEC("syscall")
int table_boundary(struct table_wake *wake)
{
	u64 now = time_to_decide_for(), next, planning;
	u32 cpu = bpf_get_smp_processor_id();
	struct cpu_state *state;
	struct timer_of_cpu *t;

	next = next_boundary(cpu, now);
	if (config.has_timer) {
		t = bpf_map_lookup_elem(&timers, &cpu);
		if (!t)
			return -1;
		bpf_timer_init(&t->timer, &timers, CLOCK_MONOTONIC);	/* in vain but once */
		bpf_timer_set_callback(&t->timer, at_boundary);
		return bpf_timer_start(&t->timer, next, BPF_F_TIMER_ABS | BPF_F_TIMER_CPU_PIN);
	}
	if (next > now + LONGEST_SLEEP)
		next = now + LONGEST_SLEEP;
	state = bpf_map_lookup_elem(&cpu_states, &cpu);
	if (!state)
		return -1;
	state->due = next;
	planning = next_boundary(cpu, next);
	if (planning > next + PLANNING_PAUSE)
		planning = next + PLANNING_PAUSE;
	wake->boundary = (struct table_instant){ next / SECOND, next % SECOND };
	wake->planning = (struct table_instant){ planning / SECOND, planning % SECOND };
	return 0;
}

/* Have every core decide now: a thread that was just assigned may be running on any. */
SEC("syscall")
int table_decide(struct table_wake *unused)
{
	int cpu;

	bpf_for(cpu, 0, config.cpu_count)
		scx_bpf_kick_cpu(cpu, SCX_KICK_PREEMPT);
	return 0;
}

s32 SEC("struct_ops.s/table_init")
BPF_PROG(table_init)
{
	s32 error = scx_bpf_create_dsq(BEST_EFFORT, -1) ?: scx_bpf_create_dsq(UNSORTED, -1);
	int id;

	bpf_for(id, 1, TABLE_MAX_SERVERS) {
		if (error)
			break;
		error = scx_bpf_create_dsq(id, -1);
	}
	return error;
}

SEC("struct_ops/table_exit")
void BPF_PROG(table_exit, struct scx_exit_info *info)
{
	u32 zero = 0;
	struct table_exit *e = bpf_map_lookup_elem(&ended, &zero);

	if (!e)
		return;
	bpf_probe_read_kernel_str(e->reason, sizeof(e->reason), info->reason);
	bpf_probe_read_kernel_str(e->message, sizeof(e->message), info->msg);
	e->kind = info->kind;
}

SEC(".struct_ops.link")
struct sched_ext_ops table_ops = {
	.flags = SCX_OPS_ENQ_LAST | SCX_OPS_ENQ_EXITING,
	.timeout_ms = 30000,
	.select_cpu = (void *)table_select_cpu,
	.enqueue = (void *)table_enqueue,
	.dispatch = (void *)table_dispatch,
	.running = (void *)table_running,
	.stopping = (void *)table_stopping,
	.cpu_release = (void *)table_cpu_release,
	.init = (void *)table_init,
	.exit = (void *)table_exit,
	.name = "chainshaper",
};

char _license[] SEC("license") = "Dual MIT/GPL";
