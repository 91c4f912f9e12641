"""`extrinsic check-device`: the bring-up of one device, step by step, with a person beside it or without."""
