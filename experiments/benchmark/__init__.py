"""Speed of jaxsimp on this machine, beside other implementations of the same computation."""
