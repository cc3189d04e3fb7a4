/* SPDX-License-Identifier: MIT OR GPL-2.0-only */
/*
 * The part of the kernel's interface that the policy uses, and how it changed from 6.12 to 7.3.
 *
 * No vmlinux.h: members and enums are found by name when the policy is loaded (CO-RE), so the
 * object fits every kernel. Functions that were renamed are declared weakly under all their names,
 * without what follows `___`: the loader resolves those that the running kernel has.
 */
#ifndef KERNEL_ABI_H
#define KERNEL_ABI_H

typedef __u64 u64;
typedef __s64 s64;
typedef __u32 u32;
typedef __s32 s32;
typedef _Bool bool;

#define FOUND_BY_NAME __attribute__((preserve_access_index))
#define KERNEL_FUNCTION __ksym __weak
#define READ_ONCE(x) (*(const volatile __typeof__(x) *)&(x))

/* <linux/bpf.h> is not included: a distribution's may be older than these. */
#define BPF_MAP_TYPE_ARRAY 2
#define BPF_MAP_TYPE_TASK_STORAGE 29
#define BPF_F_NO_PREALLOC 1
#define BPF_F_TIMER_ABS 1
#define BPF_F_TIMER_CPU_PIN 2
#define CLOCK_MONOTONIC 1

struct bpf_timer {
	__u64 opaque[2];
} __attribute__((aligned(8)));

struct bpf_iter_num {
	__u64 opaque[1];
} __attribute__((aligned(8)));

struct sched_ext_entity {
	u32 flags;
	u64 slice;
} FOUND_BY_NAME;

/*
 * Whole, though unused: libbpf rejects a prototype with a forward declaration, which is all that
 * clang emits for a struct that a member points to. Hence also `const void *` below.
 */
struct cpumask {
	unsigned long bits[1];
} FOUND_BY_NAME;

struct task_struct {
	unsigned int flags;
	int nr_cpus_allowed;
	const void *cpus_ptr;
	struct sched_ext_entity scx;
} FOUND_BY_NAME;

/* An enum here as well: CO-RE does not match an int with an enum. */
enum scx_exit_kind {
	SCX_EXIT_NONE,
};

struct scx_exit_info {
	enum scx_exit_kind kind;
	const char *reason;
	char *msg;
} FOUND_BY_NAME;

struct scx_cpu_release_args;

/* libbpf matches the members by name; `flags` is first because the loader adds to it. */
struct sched_ext_ops {
	u64 flags;
	u32 timeout_ms;
	s32 (*select_cpu)(struct task_struct *, s32, u64);
	void (*enqueue)(struct task_struct *, u64);
	void (*dispatch)(s32, struct task_struct *);
	void (*running)(struct task_struct *);
	void (*stopping)(struct task_struct *, bool);
	void (*cpu_release)(s32, struct scx_cpu_release_args *);
	s32 (*init)(void);
	void (*exit)(struct scx_exit_info *);
	char name[128];
};

#define PF_KTHREAD 0x00200000

#define SCX_TASK_QUEUED 1
#define SCX_DSQ_LOCAL ((u64)1 << 63 | 2)
#define SCX_ENQ_HEAD ((u64)1 << 16)
#define SCX_ENQ_PREEMPT ((u64)1 << 32)
#define SCX_ENQ_REENQ ((u64)1 << 40)
#define SCX_ENQ_LAST ((u64)1 << 41)
#define SCX_KICK_IDLE 1
#define SCX_KICK_PREEMPT 2
#define SCX_OPS_ENQ_LAST 2
#define SCX_OPS_ENQ_EXITING 4

int bpf_iter_num_new(struct bpf_iter_num *, int, int) KERNEL_FUNCTION;
int *bpf_iter_num_next(struct bpf_iter_num *) KERNEL_FUNCTION;
void bpf_iter_num_destroy(struct bpf_iter_num *) KERNEL_FUNCTION;

s32 scx_bpf_create_dsq(u64 dsq, s32 node) KERNEL_FUNCTION;
s32 scx_bpf_dsq_nr_queued(u64 dsq) KERNEL_FUNCTION;
s32 scx_bpf_pick_idle_cpu(const struct cpumask *, u64 flags) KERNEL_FUNCTION;
s32 scx_bpf_select_cpu_dfl(struct task_struct *, s32 previous, u64 wake_flags,
			   bool *is_idle) KERNEL_FUNCTION;
s32 scx_bpf_task_cpu(const struct task_struct *) KERNEL_FUNCTION;
void scx_bpf_error_bstr(char *format, unsigned long long *data, u32 data__sz) KERNEL_FUNCTION;
void scx_bpf_kick_cpu(s32 cpu, u64 flags) KERNEL_FUNCTION;

/* 6.12: scx_bpf_dispatch. 6.13: scx_bpf_dsq_insert. 6.19: its second version, with a result. */
void scx_bpf_dispatch___first(struct task_struct *, u64, u64, u64) KERNEL_FUNCTION;
void scx_bpf_dsq_insert___second(struct task_struct *, u64, u64, u64) KERNEL_FUNCTION;
bool scx_bpf_dsq_insert___v2___third(struct task_struct *, u64, u64, u64) KERNEL_FUNCTION;

static __always_inline void insert(struct task_struct *p, u64 dsq, u64 slice, u64 flags)
{
	if (bpf_ksym_exists(scx_bpf_dsq_insert___v2___third))
		scx_bpf_dsq_insert___v2___third(p, dsq, slice, flags);
	else if (bpf_ksym_exists(scx_bpf_dsq_insert___second))
		scx_bpf_dsq_insert___second(p, dsq, slice, flags);
	else
		scx_bpf_dispatch___first(p, dsq, slice, flags);
}

/* 6.12: scx_bpf_consume. 6.13: scx_bpf_dsq_move_to_local. 7.1: its second version, with flags. */
bool scx_bpf_consume___first(u64) KERNEL_FUNCTION;
bool scx_bpf_dsq_move_to_local___second(u64) KERNEL_FUNCTION;
bool scx_bpf_dsq_move_to_local___v2___third(u64, u64) KERNEL_FUNCTION;

static __always_inline bool move_to_local(u64 dsq)
{
	if (bpf_ksym_exists(scx_bpf_dsq_move_to_local___v2___third))
		return scx_bpf_dsq_move_to_local___v2___third(dsq, 0);
	if (bpf_ksym_exists(scx_bpf_dsq_move_to_local___second))
		return scx_bpf_dsq_move_to_local___second(dsq);
	return scx_bpf_consume___first(dsq);
}

/* Until 6.18 a policy wrote the slice itself; from 6.19 on there is a function for it. */
bool scx_bpf_task_set_slice___second(struct task_struct *, u64) KERNEL_FUNCTION;

static __always_inline void set_slice(struct task_struct *p, u64 slice)
{
	if (bpf_ksym_exists(scx_bpf_task_set_slice___second))
		scx_bpf_task_set_slice___second(p, slice);
	else
		p->scx.slice = slice;
}

/* The second version, of 6.19, returns nothing. */
u32 scx_bpf_reenqueue_local___first(void) KERNEL_FUNCTION;
void scx_bpf_reenqueue_local___v2___second(void) KERNEL_FUNCTION;

static __always_inline void reenqueue_local(void)
{
	if (bpf_ksym_exists(scx_bpf_reenqueue_local___v2___second))
		scx_bpf_reenqueue_local___v2___second();
	else
		scx_bpf_reenqueue_local___first();
}

#endif
