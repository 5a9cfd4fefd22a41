"""Closed-loop skills: what the robot can do, each one a coroutine that drives joint targets while physics runs."""
