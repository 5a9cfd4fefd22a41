"""Hydra YAML groups and the frozen dataclasses that validate them; the lowest layer."""
