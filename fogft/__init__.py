"""fogft: run ROS 2 services on cheap, unreliable machines as if on one that never fails."""

__version__ = "0.2.0"
