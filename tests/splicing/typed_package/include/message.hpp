// The type that this package shapes.

#pragma once

#include "sensor_msgs/msg/point_cloud2.hpp"

namespace chainshaper
{

using Message = sensor_msgs::msg::PointCloud2;
inline constexpr const char * message_type = "sensor_msgs/msg/PointCloud2";

}  // namespace chainshaper
