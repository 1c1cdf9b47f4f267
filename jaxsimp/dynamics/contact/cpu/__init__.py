"""Contact compiled for the CPU, and how XLA calls it."""
