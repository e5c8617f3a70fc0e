"""fogft: ROS 2 services on cheap, unreliable machines that answer as one that never fails."""

__version__ = "0.2.0"
