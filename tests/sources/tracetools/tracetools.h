/* The trace points of ros2_tracing with their signatures: Jazzy's (tracetools 8.2), or Humble's
   (4.1) with -DHUMBLE. TRACE_POINT is what stands behind each: a body, or nothing. With -DFEW a
   library exports the two of callbacks only, whose probes are set sooner. */

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifndef TRACE_POINT
#define TRACE_POINT ;
#endif

#ifndef DISABLED
void ros_trace_callback_start(const void *callback, const bool is_intra_process) TRACE_POINT
void ros_trace_callback_end(const void *callback) TRACE_POINT
#ifdef FEW
#undef TRACE_POINT
#define TRACE_POINT {}
#pragma GCC visibility push(hidden)
#endif
void ros_trace_rcl_init(const void *context_handle) TRACE_POINT
void ros_trace_rcl_node_init(const void *node_handle, const void *rmw_handle,
    const char *node_name, const char *node_namespace) TRACE_POINT
void ros_trace_rmw_publisher_init(const void *rmw_publisher_handle, const uint8_t *gid) TRACE_POINT
void ros_trace_rcl_publisher_init(const void *publisher_handle, const void *node_handle,
    const void *rmw_publisher_handle, const char *topic_name, const size_t queue_depth) TRACE_POINT
void ros_trace_rclcpp_publish(const void *publisher_handle, const void *message) TRACE_POINT
void ros_trace_rcl_publish(const void *publisher_handle, const void *message) TRACE_POINT
void ros_trace_rmw_subscription_init(const void *rmw_subscription_handle,
    const uint8_t *gid) TRACE_POINT
void ros_trace_rcl_subscription_init(const void *subscription_handle, const void *node_handle,
    const void *rmw_subscription_handle, const char *topic_name,
    const size_t queue_depth) TRACE_POINT
void ros_trace_rclcpp_subscription_init(const void *subscription_handle,
    const void *subscription) TRACE_POINT
void ros_trace_rclcpp_subscription_callback_added(const void *subscription,
    const void *callback) TRACE_POINT
void ros_trace_rmw_take(const void *rmw_subscription_handle, const void *message,
    int64_t source_timestamp, const bool taken) TRACE_POINT
void ros_trace_rcl_take(const void *message) TRACE_POINT
void ros_trace_rclcpp_take(const void *message) TRACE_POINT
void ros_trace_rcl_service_init(const void *service_handle, const void *node_handle,
    const void *rmw_service_handle, const char *service_name) TRACE_POINT
void ros_trace_rclcpp_service_callback_added(const void *service_handle,
    const void *callback) TRACE_POINT
void ros_trace_rcl_client_init(const void *client_handle, const void *node_handle,
    const void *rmw_client_handle, const char *service_name) TRACE_POINT
void ros_trace_rcl_timer_init(const void *timer_handle, int64_t period) TRACE_POINT
void ros_trace_rclcpp_timer_callback_added(const void *timer_handle,
    const void *callback) TRACE_POINT
void ros_trace_rclcpp_timer_link_node(const void *timer_handle, const void *node_handle) TRACE_POINT
void ros_trace_rclcpp_callback_register(const void *callback,
    const char *function_symbol) TRACE_POINT
void ros_trace_rcl_lifecycle_state_machine_init(const void *node_handle,
    const void *state_machine) TRACE_POINT
void ros_trace_rcl_lifecycle_transition(const void *state_machine, const char *start_label,
    const char *goal_label) TRACE_POINT
void ros_trace_rclcpp_executor_get_next_ready(void) TRACE_POINT
void ros_trace_rclcpp_executor_wait_for_work(const int64_t timeout) TRACE_POINT
void ros_trace_rclcpp_executor_execute(const void *handle) TRACE_POINT
#ifdef HUMBLE
void ros_trace_rmw_publish(const void *message) TRACE_POINT
#else
void ros_trace_rmw_publish(const void *rmw_publisher_handle, const void *message,
    int64_t timestamp) TRACE_POINT
void ros_trace_rclcpp_intra_publish(const void *publisher_handle, const void *message) TRACE_POINT
void ros_trace_rclcpp_ipb_to_subscription(const void *ipb, const void *subscription) TRACE_POINT
void ros_trace_rclcpp_buffer_to_ipb(const void *buffer, const void *ipb) TRACE_POINT
void ros_trace_rclcpp_construct_ring_buffer(const void *buffer, const uint64_t capacity) TRACE_POINT
void ros_trace_rclcpp_ring_buffer_enqueue(const void *buffer, const uint64_t index,
    const uint64_t size, const bool overwritten) TRACE_POINT
void ros_trace_rclcpp_ring_buffer_dequeue(const void *buffer, const uint64_t index,
    const uint64_t size) TRACE_POINT
void ros_trace_rclcpp_ring_buffer_clear(const void *buffer) TRACE_POINT
#endif
#ifdef FEW
#pragma GCC visibility pop
#endif
#endif
