"""DAG-Plan: one call gives a graph of actions, a scheduler carries it out on both arms."""
