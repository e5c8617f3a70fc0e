"""Real clouds through SkyPilot's public SDK: a cluster for each replica. See docs/design/sky.md."""
