"""An episode of plan steps: skills run on a world, with contingencies, observations, feedback and undo."""
