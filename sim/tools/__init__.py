"""Command-line tools that draw, film and exercise the simulator."""
