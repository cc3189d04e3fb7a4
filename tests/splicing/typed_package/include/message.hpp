// The type that this package shapes.

#ifndef SHAPING_SENSOR_MSGS_POINT_CLOUD2__MESSAGE_HPP_
#define SHAPING_SENSOR_MSGS_POINT_CLOUD2__MESSAGE_HPP_

#include "sensor_msgs/msg/point_cloud2.hpp"

namespace chainshaper
{

using Message = sensor_msgs::msg::PointCloud2;
inline constexpr const char * message_type = "sensor_msgs/msg/PointCloud2";

}  // namespace chainshaper

#endif  // SHAPING_SENSOR_MSGS_POINT_CLOUD2__MESSAGE_HPP_
