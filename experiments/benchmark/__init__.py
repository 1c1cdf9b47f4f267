"""How fast jaxsimp is on this machine, beside other ways to compute the same."""
