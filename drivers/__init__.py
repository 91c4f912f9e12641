"""The devices: abstract interfaces, the wire, the log, and the simulated, real and replay backends."""
