"""Tables of many trials from one file: which calibrations, which runs, and what is printed beside whose figures."""
