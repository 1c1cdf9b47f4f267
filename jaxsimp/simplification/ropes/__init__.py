"""Ropes: chains of segments through key points."""
