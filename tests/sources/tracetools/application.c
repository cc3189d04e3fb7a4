/* An application in the eyes of its tracer: it calls the trace points as rclcpp, rcl and an RMW do,
   and prints what it passed, when, and how much CPU time it used.

   application every         each function once, some with values that are hard to read
   application chain N       two nodes; the timer of /first publishes /ebpf1, which /second takes and
                             answers on /ebpf2; N cycles of 50 ms. With a third argument it says
                             "ready" once its objects exist, and begins when it reads a line.
   application flood N       N callback_end on one core, as fast as possible; it says "ready", reads
                             a line, and does one more: losses are told with the next event that
                             a buffer has room for

   Lines of `every`: event, thread, time before, time after, arguments; text and gids in hex.
   Lines of `chain`: "instance", callback, start, end, CPU time; "publication", topic, time. */

#define _GNU_SOURCE
#include <pthread.h>
#include <sched.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "tracetools.h"

static int64_t clock_ns(clockid_t clock) {
    struct timespec now;
    clock_gettime(clock, &now);
    return now.tv_sec * 1000000000LL + now.tv_nsec;
}

static int64_t now(void) { return clock_ns(CLOCK_MONOTONIC); }

static void print_hex(const void *bytes, size_t count) {
    for (size_t i = 0; i < count; i++) printf("%02x", ((const uint8_t *)bytes)[i]);
}

/* Letters of `format`: h handle, i integer, b flag, s text, g gid. */
static void report(const char *event, const char *format, int64_t before, int64_t after, ...) {
    va_list values;
    va_start(values, after);
    printf("%s\t%d\t%lld\t%lld", event, gettid(), (long long)before, (long long)after);
    for (; *format; format++) {
        printf("\t");
        const char *text;
        switch (*format) {
            case 'h': printf("%llu", (unsigned long long)va_arg(values, void *)); break;
            case 'i': printf("%lld", (long long)va_arg(values, int64_t)); break;
            case 'b': printf("%d", va_arg(values, int)); break;
            case 'g': print_hex(va_arg(values, uint8_t *), 24); break;
            case 's': text = va_arg(values, char *); print_hex(text, strlen(text)); break;
        }
    }
    printf("\n");
    va_end(values);
}

#define CALL(event, format, ...)                                       \
    do {                                                               \
        int64_t before = now();                                        \
        ros_trace_##event(__VA_ARGS__);                                \
        report(#event, format, before, now() __VA_OPT__(,) __VA_ARGS__); \
    } while (0)

/* Another one wherever it stands, as large as addresses get. */
#define HANDLE ((void *)(0x7ffffff00000 + 0x101 * __COUNTER__))

static void long_names(void) { /* of all lengths up to the longest topic, at all alignments */
    static char text[600];
    for (size_t length = 0; length <= 255; length += length < 70 ? 1 : 37) {
        char *name = text + length % 9;
        for (size_t i = 0; i < length; i++) name[i] = "/abcdefghijklmnopqrstuvwxyz_0123"[(i + length) % 32];
        name[length] = 0;
        memset(name + length + 1, 0xee, 80); /* what lies behind is no part of it */
        CALL(rcl_service_init, "hhhs", HANDLE, HANDLE, HANDLE, name);
    }
}

static void *on_another_thread(void *unused) {
    (void)unused;
    CALL(rcl_take, "h", HANDLE);
    return NULL;
}

static void call_every(void) {
    uint8_t gid[24];
    for (int i = 0; i < 24; i++) gid[i] = (uint8_t)(i * 37 + 9); /* tab, newline, backslash … */
    CALL(rcl_init, "h", HANDLE);
    CALL(rcl_node_init, "hhss", HANDLE, HANDLE, "node with\ta tab, a \n and ü", "/");
    CALL(rmw_publisher_init, "hg", HANDLE, gid);
    CALL(rcl_publisher_init, "hhhsi", HANDLE, HANDLE, HANDLE, "/topic", (int64_t)10);
    CALL(rclcpp_publish, "hh", NULL, HANDLE);
    CALL(rcl_publish, "hh", HANDLE, HANDLE);
    CALL(rmw_subscription_init, "hg", HANDLE, gid);
    CALL(rcl_subscription_init, "hhhsi", HANDLE, HANDLE, HANDLE, "/topic", (int64_t)1000);
    CALL(rclcpp_subscription_init, "hh", HANDLE, HANDLE);
    CALL(rclcpp_subscription_callback_added, "hh", HANDLE, HANDLE);
    CALL(rmw_take, "hhib", HANDLE, HANDLE, (int64_t)1795213168277173946, true);
    CALL(rclcpp_take, "h", HANDLE);
    CALL(rclcpp_service_callback_added, "hh", HANDLE, HANDLE);
    CALL(rcl_client_init, "hhhs", HANDLE, HANDLE, HANDLE, "/service");
    CALL(rcl_timer_init, "hi", HANDLE, (int64_t)100000000);
    CALL(rclcpp_timer_callback_added, "hh", HANDLE, HANDLE);
    CALL(rclcpp_timer_link_node, "hh", HANDLE, HANDLE);
    CALL(rclcpp_callback_register, "hs", HANDLE, "void (*)(std::shared_ptr<Message>)");
    CALL(rcl_lifecycle_state_machine_init, "hh", HANDLE, HANDLE);
    CALL(rcl_lifecycle_transition, "hss", HANDLE, "inactive", "active");
    CALL(callback_start, "hb", HANDLE, true);
    CALL(callback_end, "h", HANDLE);
    CALL(rclcpp_executor_get_next_ready, "");
    CALL(rclcpp_executor_wait_for_work, "i", (int64_t)-1);
    CALL(rclcpp_executor_execute, "h", HANDLE);
#ifdef HUMBLE
    CALL(rmw_publish, "h", HANDLE);
#else
    CALL(rmw_publish, "hhi", HANDLE, HANDLE, (int64_t)1795213168277173946);
    CALL(rclcpp_intra_publish, "hh", HANDLE, HANDLE);
    CALL(rclcpp_ipb_to_subscription, "hh", HANDLE, HANDLE);
    CALL(rclcpp_buffer_to_ipb, "hh", HANDLE, HANDLE);
    CALL(rclcpp_construct_ring_buffer, "hi", HANDLE, (int64_t)10);
    CALL(rclcpp_ring_buffer_enqueue, "hiib", HANDLE, (int64_t)1, (int64_t)2, true);
    CALL(rclcpp_ring_buffer_dequeue, "hii", HANDLE, (int64_t)1, (int64_t)2);
    CALL(rclcpp_ring_buffer_clear, "h", HANDLE);
#endif
    long_names();
    /* The calling convention leaves the upper bytes of a bool's register undefined. */
    void (*start)(const void *, uint64_t) = (void (*)(const void *, uint64_t))ros_trace_callback_start;
    void *callback = &start;
    int64_t before = now();
    start(callback, 0xabcdef00);
    report("callback_start", "hb", before, now(), callback, false);
    pthread_t thread;
    pthread_create(&thread, NULL, on_another_thread, NULL);
    pthread_join(thread, NULL);
}

/* As in rmw/types.h: so begin rmw_publisher_t and rmw_subscription_t. */
struct endpoint {
    const char *implementation_identifier;
    void *data;
    const char *topic_name;
};

/* As in rcl: rcl_publisher_t, and rcl_publisher_impl_t of Humble, where the RMW's handle is behind
   options, QoS and context. */
struct rcl_publisher {
    struct {
        char before[240];
        struct endpoint *rmw_handle;
    } *impl;
};

static struct endpoint writer_1 = {"rmw_test_cpp", NULL, "/ebpf1"};
static struct endpoint writer_2 = {"rmw_test_cpp", NULL, "/ebpf2"};
static struct endpoint reader_1 = {"rmw_test_cpp", NULL, "/ebpf1"};
static struct rcl_publisher publisher_1, publisher_2;
static int node_1, node_2, timer, timer_callback, subscription, reader_callback, message;
static uint8_t gid[24] = {0x01, 0x10};

static void create(struct rcl_publisher *publisher, void *node, struct endpoint *writer) {
    publisher->impl = calloc(1, sizeof *publisher->impl);
    publisher->impl->rmw_handle = writer;
    ros_trace_rmw_publisher_init(writer, gid);
    ros_trace_rcl_publisher_init(publisher, node, writer, writer->topic_name, 7);
}

static void wait_for_line(void) {
    printf("ready\n");
    fflush(stdout);
    getchar();
}

static void create_all(void) {
    ros_trace_rcl_init(&node_1);
    ros_trace_rcl_node_init(&node_1, &node_1, "first", "/");
    ros_trace_rcl_node_init(&node_2, &node_2, "second", "/");
    create(&publisher_1, &node_1, &writer_1);
    create(&publisher_2, &node_2, &writer_2);
    ros_trace_rmw_subscription_init(&reader_1, gid);
    ros_trace_rcl_subscription_init(&subscription, &node_2, &reader_1, "/ebpf1", 7);
    ros_trace_rclcpp_subscription_init(&subscription, &reader_1);
    ros_trace_rclcpp_subscription_callback_added(&reader_1, &reader_callback);
    ros_trace_rcl_timer_init(&timer, 50000000);
    ros_trace_rclcpp_timer_callback_added(&timer, &timer_callback);
    ros_trace_rclcpp_timer_link_node(&timer, &node_1);
}

static int64_t publish(struct rcl_publisher *publisher, struct endpoint *writer) {
    int64_t at = now(), stamp;
    ros_trace_rclcpp_publish(NULL, &message);
    ros_trace_rcl_publish(publisher, &message);
#ifdef HUMBLE
    ros_trace_rmw_publish(&message);
    stamp = clock_ns(CLOCK_REALTIME);
#else
    stamp = clock_ns(CLOCK_REALTIME);
    ros_trace_rmw_publish(writer, &message, stamp);
#endif
    printf("publication\t%s\t%lld\n", writer->topic_name, (long long)at);
    return stamp;
}

/* A callback that computes for some milliseconds, waits for one, and publishes. */
static int64_t run(void *callback, struct rcl_publisher *publisher, struct endpoint *writer) {
    int64_t start = now(), used = clock_ns(CLOCK_THREAD_CPUTIME_ID);
    ros_trace_callback_start(callback, false);
    while (clock_ns(CLOCK_THREAD_CPUTIME_ID) < used + 2000000) {}
    usleep(1000);
    int64_t stamp = publish(publisher, writer);
    ros_trace_callback_end(callback);
    int64_t end = now();
    used = clock_ns(CLOCK_THREAD_CPUTIME_ID) - used;
    printf("instance\t%llu\t%lld\t%lld\t%lld\n", (unsigned long long)callback, (long long)start,
           (long long)end, (long long)used);
    return stamp;
}

static void run_chain(int cycles) {
    struct timespec next;
    clock_gettime(CLOCK_MONOTONIC, &next);
    for (int cycle = 0; cycle < cycles; cycle++) {
        next.tv_nsec += 50000000;
        if (next.tv_nsec >= 1000000000) next.tv_sec++, next.tv_nsec -= 1000000000;
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &next, NULL);
        int64_t stamp = run(&timer_callback, &publisher_1, &writer_1);
        ros_trace_rmw_take(&reader_1, &message, stamp, true);
        ros_trace_rcl_take(&message);
        ros_trace_rclcpp_take(&message);
        run(&reader_callback, &publisher_2, &writer_2);
    }
}

static void flood(int times) {
    cpu_set_t here;
    CPU_ZERO(&here);
    CPU_SET(sched_getcpu(), &here);
    sched_setaffinity(0, sizeof here, &here);
    for (int i = 0; i < times; i++) ros_trace_callback_end(&message);
    wait_for_line();
    ros_trace_callback_end(&message);
}

int main(int count, char **arguments) {
    const char *what = count > 1 ? arguments[1] : "";
    int times = count > 2 ? atoi(arguments[2]) : 0;
    if (!strcmp(what, "every")) call_every();
    if (!strcmp(what, "flood")) flood(times);
    if (!strcmp(what, "chain")) {
        create_all();
        if (count > 3) wait_for_line();
        run_chain(times);
    }
    return 0;
}
