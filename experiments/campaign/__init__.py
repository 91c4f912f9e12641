"""Campaigns: many runs of experiments on Dask's workers, kept on disk, continued where they stopped."""
