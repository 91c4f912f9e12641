"""From readings to state."""
