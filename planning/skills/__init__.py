"""The manipulation skills of the paper, one file each."""
