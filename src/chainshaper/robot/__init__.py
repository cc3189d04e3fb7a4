"""All that runs inside ROS nodes: the gate's decision, nodes, libraries before rmw."""
