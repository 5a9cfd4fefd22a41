"""Training data out of the simulator: views, text planning, demonstrations, replayed motion."""
