"""Frozen dataclasses behind the YAML groups, one module per concern."""
