"""A planner of rules: it reads the instruction's words and the feedback's codes, and learns nothing."""
