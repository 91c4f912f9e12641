"""The report of a campaign: one HTML file over all its trials, which leads to each run's own and works off line."""
