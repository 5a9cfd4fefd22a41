"""Contracts between simulator, training data and planners; numpy and the standard library alone."""
