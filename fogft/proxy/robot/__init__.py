"""The client proxy: offers the service on the robot and asks the replicas."""
