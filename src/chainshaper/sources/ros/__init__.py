"""What an application's own ROS 2 tells while it runs: graph, QoS, parameters."""
