"""Real clouds through SkyPilot's public SDK. Not here: which offer is bought (`fogft.planning`)."""
