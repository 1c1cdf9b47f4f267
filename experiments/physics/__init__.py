"""Figures of docs/physics.md: `python -m experiments.physics`."""
