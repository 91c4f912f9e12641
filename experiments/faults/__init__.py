"""The fault campaign: every fault, at every device, at every moment of a trial, and what has to come of it."""
