"""`extrinsic view`: a recorded run, or a live station, in Rerun."""
