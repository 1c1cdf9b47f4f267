"""Studies with jaxsimp: `python -m experiments.run`."""
