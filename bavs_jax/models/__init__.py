"""Radiance models: what is trained, rendered and asked how its colours change."""
