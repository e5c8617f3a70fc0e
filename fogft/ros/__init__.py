"""The ROS 2 side of the proxies: serialised services and clients. rclpy stays in here."""
