"""Making of the 359 tasks: sampling, composition and the expert's certificates."""
