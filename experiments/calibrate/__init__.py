"""What a station knows of itself: the calibration files, and the stages that make them."""
