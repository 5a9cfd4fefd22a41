"""Tasks: goal predicates, task records, the benchmark and the sampler of training tasks."""
