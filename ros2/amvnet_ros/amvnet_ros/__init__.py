"""A ROS 2 node that gives every point of a LiDAR scan its class, by AMVNet."""
