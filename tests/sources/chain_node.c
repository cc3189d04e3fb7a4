/* A stand-in for a ROS 2 node with LTTng trace points: the events of rclcpp, without rclcpp.
 *
 *   chain_node source CYCLES PERIOD_US   timer -> /x; a line on standard output per message
 *   chain_node relay                     /x (lines on standard input) -> /y
 *   chain_node flood COUNT PAUSE_US      callbacks, PAUSE_US apart, as fast as can be with 0
 *   chain_node busy CYCLES               callbacks that compute, wait and publish; a line with
 *                                        process and CPU time of each
 *   chain_node exit CODE                 a node that is created, and ends with this code
 *   chain_node deaf                      one that ignores SIGINT and SIGTERM
 *
 * Behind these, `--ros-args` may follow. Two threads are named as Cyclone DDS names its own.
 */
#define _GNU_SOURCE
#define TRACEPOINT_CREATE_PROBES
#define TRACEPOINT_DEFINE
#include "ros2_provider.h"

#include <inttypes.h>
#include <pthread.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum { NODE = 0x1000, TIMER = 0x2000, PUBLISHER = 0x3000, SUBSCRIPTION = 0x4000, CALLBACK = 0x5000 };
enum { RMW = 0x100, MESSAGE = 0x6000, CONTEXT = 0x7000, DEPTH = 7 };

static int64_t now(clockid_t clock)
{
	struct timespec t;
	clock_gettime(clock, &t);
	return t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
}

static void *sleeping(void *name)
{
	pthread_setname_np(pthread_self(), name);
	for (;;)
		pause();
}

static void create_node(const char *name)
{
	static char *names[] = {"recvUC", "tev"};
	pthread_t thread;
	for (int i = 0; i < 2; i++)
		pthread_create(&thread, NULL, sleeping, names[i]);
	tracepoint(ros2, rcl_init, CONTEXT, "8.2.3");
	tracepoint(ros2, rcl_node_init, NODE, NODE + RMW, name, "/");
}

static void create_publisher(const char *topic)
{
	static uint8_t gid[24] = {0x01, 0x10}; /* Cyclone DDS */
	tracepoint(ros2, rmw_publisher_init, PUBLISHER + RMW, gid);
	tracepoint(ros2, rcl_publisher_init, PUBLISHER, NODE, PUBLISHER + RMW, topic, DEPTH);
}

static void create_timer(int64_t period)
{
	tracepoint(ros2, rcl_timer_init, TIMER, period);
	tracepoint(ros2, rclcpp_timer_callback_added, TIMER, CALLBACK);
	tracepoint(ros2, rclcpp_callback_register, CALLBACK, "Source::tick()");
	tracepoint(ros2, rclcpp_timer_link_node, TIMER, NODE);
}

static void create_subscription(const char *topic)
{
	static uint8_t gid[24] = {0x01, 0x10};
	tracepoint(ros2, rmw_subscription_init, SUBSCRIPTION + RMW, gid);
	tracepoint(ros2, rcl_subscription_init, SUBSCRIPTION, NODE, SUBSCRIPTION + RMW, topic, DEPTH);
	tracepoint(ros2, rclcpp_subscription_init, SUBSCRIPTION, SUBSCRIPTION + 1);
	tracepoint(ros2, rclcpp_subscription_callback_added, SUBSCRIPTION + 1, CALLBACK);
	tracepoint(ros2, rclcpp_callback_register, CALLBACK, "Relay::on_x()");
}

static int64_t publish(void)
{
	int64_t stamp = now(CLOCK_REALTIME);
	tracepoint(ros2, rclcpp_publish, MESSAGE);
	tracepoint(ros2, rcl_publish, PUBLISHER, MESSAGE);
	tracepoint(ros2, rmw_publish, PUBLISHER + RMW, MESSAGE, stamp);
	return stamp;
}

static void source(long cycles, long period_us)
{
	int64_t due = now(CLOCK_MONOTONIC);
	create_node("source");
	create_publisher("/x");
	create_timer(period_us * 1000);
	for (long i = 0; i < cycles; i++) {
		due += period_us * 1000;
		struct timespec t = {due / 1000000000, due % 1000000000};
		clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL);
		tracepoint(ros2, callback_start, CALLBACK, 0);
		printf("%" PRId64 "\n", publish());
		fflush(stdout);
		tracepoint(ros2, callback_end, CALLBACK);
	}
}

static void relay(void)
{
	int64_t stamp;
	create_node("relay");
	create_publisher("/y");
	create_subscription("/x");
	while (scanf("%" SCNd64, &stamp) == 1) {
		tracepoint(ros2, rmw_take, SUBSCRIPTION + RMW, MESSAGE, stamp, 1);
		tracepoint(ros2, rcl_take, MESSAGE);
		tracepoint(ros2, rclcpp_take, MESSAGE);
		tracepoint(ros2, callback_start, CALLBACK, 0);
		publish();
		tracepoint(ros2, callback_end, CALLBACK);
	}
}

static void flood(long count, long pause_us)
{
	create_node("flood");
	create_publisher("/x");
	create_timer(1000);
	for (long i = 0; i < count; i++) {
		tracepoint(ros2, callback_start, CALLBACK, 0);
		publish();
		tracepoint(ros2, callback_end, CALLBACK);
		if (pause_us)
			usleep(pause_us);
	}
}

static void busy(long cycles)
{
	create_node("busy");
	create_publisher("/x");
	create_timer(10000000);
	for (long i = 0; i < cycles; i++) {
		usleep(10000);
		tracepoint(ros2, callback_start, CALLBACK, 0);
		int64_t before = now(CLOCK_THREAD_CPUTIME_ID), after;
		while (now(CLOCK_THREAD_CPUTIME_ID) < before + 20000000) {
		}
		usleep(5000);
		publish();
		after = now(CLOCK_THREAD_CPUTIME_ID);
		tracepoint(ros2, callback_end, CALLBACK);
		printf("%d %" PRId64 "\n", getpid(), after - before);
	}
}

int main(int argc, char **argv)
{
	const char *role = argc > 1 ? argv[1] : "";
	if (!strcmp(role, "source"))
		source(atol(argv[2]), atol(argv[3]));
	else if (!strcmp(role, "relay"))
		relay();
	else if (!strcmp(role, "flood"))
		flood(atol(argv[2]), atol(argv[3]));
	else if (!strcmp(role, "busy"))
		busy(atol(argv[2]));
	else if (!strcmp(role, "exit")) {
		create_node("short_lived");
		return atoi(argv[2]);
	} else if (!strcmp(role, "deaf")) {
		signal(SIGINT, SIG_IGN);
		signal(SIGTERM, SIG_IGN);
		create_node("deaf");
		sleeping("deaf");
	}
	return 0;
}
