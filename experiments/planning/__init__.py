"""Plans in experiments: what a plan stage may say, how a plan is made from it, and plans as files of a run."""
