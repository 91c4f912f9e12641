"""The simulated station: a MuJoCo plant and the simulated devices around it."""
