"""The running world: physics and time, and the owners of what changes in it."""
