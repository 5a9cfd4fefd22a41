"""Command-line tools that draw, film and try the simulator."""
