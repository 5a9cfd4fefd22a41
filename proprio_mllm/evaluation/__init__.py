"""Evaluation: episodes of a planner in the simulator, why they failed, and the ledger that remembers them."""
