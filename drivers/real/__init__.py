"""Real devices, one file each."""
