"""Studies that lean on jaxsimp: `python -m experiments.run`."""
